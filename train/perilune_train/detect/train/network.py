"""Build a network with anchors fitted to the training labels; load a teacher."""

from pathlib import Path

import lightning
import numpy as np
import torch

from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.inference.detector import load_detector
from perilune_train.detect.train.anchors import best_possible_recall, kmeans_anchors
from perilune_train.detect.train.distill import Teacher
from perilune_train.models.yolo import ANCHORS_PER_SCALE, YOLOv3
from perilune_train.training import runs

_ANCHOR_STREAM = 1


def build_network(config: DetectConfig, sizes_px: np.ndarray, where: object) -> YOLOv3:
    """Build the network with anchors for these label sizes (N, 2). Raises UserError if there are no labels."""
    if len(sizes_px) == 0:
        raise UserError(where, "labels", "no visible crater in the training split", "at least one")
    count = len(config.strides) * ANCHORS_PER_SCALE
    rng = np.random.default_rng([config.seed, _ANCHOR_STREAM])
    anchors = kmeans_anchors(sizes_px, count, rng, plain=config.anchor_sampling == "plain")
    lightning.seed_everything(config.seed, verbose=False)
    shaped = torch.as_tensor(anchors).view(len(config.strides), ANCHORS_PER_SCALE, 2)
    return YOLOv3(shaped, config.in_channels, config.width, config.attention, config.strides)


def load_teacher(path: Path, config: DetectConfig) -> Teacher:
    """Load the teacher. Raises UserError if its input channels or strides differ from the student's."""
    network = load_detector(path)
    expected = {"in_channels": config.in_channels, "strides": list(config.strides)}
    runs.check_architecture(path, runs.load_weights(path)["architecture"], expected)
    return Teacher(network.requires_grad_(False))


def anchor_sizes(network: YOLOv3) -> np.ndarray:
    """Widths and heights (N, 2) in pixels of a network's anchors."""
    return network.anchors.flatten(0, 1).double().cpu().numpy()


def anchor_report(network: YOLOv3, sizes_px: np.ndarray, ratio: float) -> str:
    """State how well a network's anchors fit labels of these sizes (N, 2): the best recall that training can reach."""
    recall = best_possible_recall(sizes_px, anchor_sizes(network), ratio)
    return (
        f"anchors: best possible recall {recall:.4f}, the fraction of training labels with an anchor within a factor "
        f"of {ratio:g} in width and height"
    )
