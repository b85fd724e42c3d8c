"""Initial weights from an earlier run or a weight file of Darknet, and export to Darknet's format."""

from pathlib import Path
from typing import Any, Literal

import torch

from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.models.darknet import AttentionDarknet53
from perilune_train.models.darknet_weights import (
    COCO_FILTERS,
    DarknetFile,
    backbone_slots,
    content_of,
    count_floats,
    fill_slots,
    is_darknet,
    network_slots,
    read_darknet,
)
from perilune_train.models.yolo import YOLOv3
from perilune_train.records.provenance import Provenance, read_provenance
from perilune_train.shipped.models import weights_file
from perilune_train.training import runs

_GREY_MEAN, _GREY_DEVIATION = 0.45, 0.25
"""Approximate mean and standard deviation of photographs on Darknet's scale of 0 to 1. The deviation is a power of two,
so scaling by it is exact."""
_GATES, _ELLIPSES = "backbone.attentions.", "ellipse_tower."
DARKNET_SHAPE = {"width": 1.0, "in_channels": 3}


@torch.no_grad()
def rescale_input(backbone: AttentionDarknet53, to: Literal["normalised", "grey"]) -> None:
    """Change the stem of a backbone so that it gives equal features for another scale of the input.

    Darknet's files were trained on grey values from 0 to 1 (`grey`). Our networks take frames with zero mean and unit
    standard deviation (`normalised`). Without this change the input of a frozen backbone would be about four times as
    strong as in training. grey = 0.25 normalised + 0.45 is folded into the weights of the stem and the mean of its
    batch norm. This is exact except for rounding, and for the border, where zero padding then means mean grey.
    """
    stem: Any = backbone.stem
    weight, mean = stem.conv.weight, stem.norm.running_mean
    shift = _GREY_MEAN * weight.double().sum((1, 2, 3))
    if to == "normalised":
        weight *= _GREY_DEVIATION
        mean.copy_(mean.double() - shift)
    else:
        weight /= _GREY_DEVIATION
        mean.copy_(mean.double() + shift / _GREY_DEVIATION)


def check_start(path: Path) -> None:
    """Raise UserError unless a file has weights of YOLOv3 or Darknet53 in Darknet's format."""
    if not path.is_file():
        raise UserError(path, "initial weights", "no such file", "yolov3.weights or darknet53.conv.74")
    if not is_darknet(path):
        raise UserError(path, "initial weights", "another format", "yolov3.weights or darknet53.conv.74")
    start_from_darknet(YOLOv3(), path, DetectConfig())


def start_from(network: YOLOv3, path: Path, config: DetectConfig) -> None:
    """Fill the network with weights of an earlier detect run or of a Darknet file.

    A run with equal strides gives all weights and the anchors; a run with other strides gives only the backbone. If the
    attention differs, the network's gates keep their initial weights; ellipse outputs keep theirs if the run has none.
    With `detect.init_layers=from_second`, the first convolution and its norm keep theirs.

    Raises UserError if width or in_channels differ, or if a frozen backbone would have plain gates with random weights.
    """
    stem = {key: value.clone() for key, value in network.backbone.stem.state_dict().items()}
    _fill(network, path, config)
    if config.init_layers == "from_second":
        network.backbone.stem.load_state_dict(stem)


def _fill(network: YOLOv3, path: Path, config: DetectConfig) -> None:
    if is_darknet(path):
        check_gates(path, config)
        start_from_darknet(network, path, config)
        return
    content = runs.load_weights(path)
    architecture = content["architecture"]
    runs.check_architecture(path, architecture, {"in_channels": config.in_channels, "width": config.width})
    whole = architecture.get("strides") == list(config.strides)
    gates = architecture.get("attention") == config.attention
    if not gates:
        check_gates(path, config)

    def taken(key: str) -> bool:
        if key.startswith(_ELLIPSES) and not (network.ellipses and architecture.get("ellipses")):
            return False
        return (whole or key.startswith("backbone.")) and (gates or not key.startswith(_GATES))

    kept = {key: value for key, value in network.state_dict().items() if not taken(key)}
    runs.load_state(network, kept | {key: value for key, value in content["state_dict"].items() if taken(key)}, path)


def check_gates(path: Path, config: DetectConfig) -> None:
    """Raise UserError if a frozen backbone would have plain gates with random initial weights.

    These gates scale their input by about 0.25, so the frozen layers get features on which they were not trained: the
    cosine similarity to the features of the backbone without gates falls to about 0.5 (`make bench-transfer`).
    """
    if config.frozen_epochs and config.attention == "cbam" and not config.plain_gates_before_frozen_layers:
        expected = (
            "cbam_identity, whose gates start at 1 and keep the features of the frozen backbone, or frozen_epochs=0"
        )
        raise UserError(path, "detect.attention", "cbam with frozen_epochs and no gates in this file", expected)


def inherited_terrain(config: DetectConfig, last: Path | None) -> list[Provenance]:
    """Terrain records of the network that gave the initial weights, and of the teacher.

    A resumed run reads the records from its last saved state, `last`. Darknet's files have no records: they were
    trained on photographs of the Earth. Raises UserError if a checkpoint is missing or damaged.
    """
    if last is not None:
        content = runs.read_saved(last, "last state", {"state_dict"}, "the state of an interrupted run")
        return [read_provenance(content, last)]
    paths = [weights_file(path) for path in (config.init_from, config.teacher) if path is not None]
    return [read_provenance(runs.load_weights(path), path) for path in paths if not is_darknet(path)]


def start_from_darknet(network: YOLOv3, path: Path, config: DetectConfig) -> None:
    """Fill a network with the weights of a Darknet file; other weights are not changed.

    darknet53.conv.74 fills the backbone. yolov3.weights also fills the neck and the heads' 3 x 3 convolutions if the
    strides are 8, 16, 32; with other strides it fills only the backbone. The output layers of yolov3.weights are not
    used: they predict COCO's 80 classes with COCO's anchors, and would undo the prior that a cell is empty. The output
    layers of a file written by perilune (15 filters) are used.

    Raises UserError, and changes nothing, if width is not 1, in_channels is not 3 or the file has another size.
    """
    for key, value in DARKNET_SHAPE.items():
        if getattr(config, key) != value:
            raise UserError(path, f"detect.{key}", getattr(config, key), f"{value:g}, as in Darknet's files")
    backbone = backbone_slots(network.backbone)
    with torch.device("meta"):
        whole = YOLOv3()
    n_backbone, n_ours, n_coco = (
        count_floats(slots) for slots in (backbone, network_slots(whole), network_slots(whole, COCO_FILTERS))
    )
    content = read_darknet(path, (n_backbone, n_ours, n_coco))
    n = len(content.values)
    if n == n_backbone or network.strides != whole.strides:
        fill_slots(backbone, content, path)
    else:
        fill_slots(network_slots(network, COCO_FILTERS) if n == n_coco else network_slots(network), content, path)
    rescale_input(network.backbone, "normalised")


def darknet_content(network: YOLOv3, architecture: dict[str, Any], checkpoint: Path, whole: bool) -> DarknetFile:
    """Darknet file of a network's backbone, or of the `whole` network with 15 output filters.

    Changes the network's stem. Darknet files cannot hold attention gates or ellipse outputs. Raises UserError if the
    network does not have the shape of the file.
    """
    expected: dict[str, Any] = dict(DARKNET_SHAPE)
    if whole:
        expected |= {"strides": [8, 16, 32], "attention": "none", "ellipses": False}
    runs.check_architecture(checkpoint, {"ellipses": False, **architecture}, expected)
    rescale_input(network.backbone, "grey")
    return content_of(network_slots(network) if whole else backbone_slots(network.backbone))
