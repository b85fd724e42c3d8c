"""Darknet's weight files: `darknet53.conv.74` (the backbone) and `yolov3.weights` (the whole network).

A file has a header, then little-endian float32 values for each convolution in the order of the network's cfg. A
convolution with batch norm stores bias, scale, mean, variance, weights (out, in, k, k). A convolution without batch
norm stores bias, weights. The header has major, minor and revision as int32, then the number of images seen. This
number has 8 bytes if major * 10 + minor >= 2 and both are below 1000, otherwise 4.

Source: the weight files of Redmon & Farhadi 2018 (arXiv 1804.02767), in the format that Darknet reads.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_bytes
from perilune_train.models.darknet import UNITS, AttentionDarknet53
from perilune_train.models.yolo import ANCHORS_PER_SCALE, OUTPUTS, YOLOv3

COCO_FILTERS = 255
"""Channels of an output layer of yolov3.weights: 3 anchors x (box, objectness, 80 classes). `YOLOv3` has 15."""
_FILTERS = ANCHORS_PER_SCALE * OUTPUTS
_VERSION = struct.Struct("<3i")
_NEW_HEADER = _VERSION.pack(0, 2, 0) + struct.pack("<Q", 0)
_CHECKPOINT_START = b"PK\x03\x04"
_TENSORS_WITH_NORM = ("bias", "scale", "mean", "variance", "weights")
_TENSORS_WITHOUT = ("bias", "weights")


@dataclass(frozen=True)
class DarknetFile:
    """Content of a file. `write_darknet` reproduces the file byte for byte."""

    header: bytes
    """Version and number of images seen, 16 or 20 bytes."""
    values: NDArray[np.float32]
    """All floats in the order of the file (N,)."""


@dataclass(frozen=True)
class Slot:
    """A position in the file, and the network's tensor that is stored there."""

    name: str
    """Name for messages: number of the convolution, counted from 0, and kind of tensor."""
    tensor: Tensor
    """The tensor in the network, not a copy."""
    floats: int
    """Number of floats in the file. For an output layer it depends on the number of classes."""


def backbone_slots(backbone: AttentionDarknet53) -> list[Slot]:
    """The backbone's tensors in the order of darknet53.conv.74, without attention gates."""
    return _numbered(_backbone_blocks(backbone))


def network_slots(network: YOLOv3, filters: int = _FILTERS) -> list[Slot]:
    """All tensors of a network with strides 8, 16, 32, in the order of yolov3.cfg.

    `filters` is the number of channels of the output layers. The order is the order of execution: first the backbone;
    then, for each of the strides 32, 16 and 8, the branch, the head and, except for stride 8, the lateral convolution
    to the next stride. Raises ValueError for other strides.
    """
    if network.strides != (8, 16, 32):
        raise ValueError(f"strides are {network.strides}, not (8, 16, 32)")
    blocks = _backbone_blocks(network.backbone)
    for stride in ("32", "16", "8"):
        blocks += [*network.branches[stride], *network.heads[stride]]  # type: ignore[misc]
        if stride in network.laterals:
            blocks.append(network.laterals[stride][0])  # type: ignore[index]
    return _numbered(blocks, filters)


def count_floats(slots: Sequence[Slot]) -> int:
    """Number of floats in a file with these slots."""
    return sum(slot.floats for slot in slots)


def is_darknet(path: Path) -> bool:
    """Whether a file is a Darknet weight file.

    True if the file is not a torch checkpoint and has the name of a Darknet file or a header with a plausible version.
    """
    start = b""
    if path.is_file():
        with path.open("rb") as stream:
            start = stream.read(_VERSION.size)
    if start.startswith(_CHECKPOINT_START):
        return False
    if path.name.endswith((".weights", ".conv.74")):
        return True
    return len(start) == _VERSION.size and all(0 <= number < 1000 for number in _VERSION.unpack(start))


def read_darknet(path: Path, expected: Sequence[int]) -> DarknetFile:
    """Read a file whose number of floats is one of `expected`; checks the size before reading.

    Raises UserError if the file is missing, has another size, or holds a number that is not finite.
    """
    if not path.is_file():
        raise UserError(path, "weights", "no such file", "darknet53.conv.74 or yolov3.weights")
    size = path.stat().st_size
    with path.open("rb") as stream:
        version = stream.read(_VERSION.size)
        length = _header_bytes(path, version)
        header = version + stream.read(length - len(version))
        whole, rest = divmod(size - length, 4)
        if size < length or rest or whole not in expected:
            content = "an incomplete header" if size < length else f"a header and {whole} floats and {rest} bytes"
            got = f"{size} bytes: {content.removesuffix(' and 0 bytes')}"
            raise UserError(path, "size", got, f"{' or '.join(map(str, expected))} floats")
        values = np.fromfile(stream, "<f4", whole).astype(np.float32, copy=False)
    finite = np.isfinite(values)
    if not finite.all():
        first = int(finite.argmin())
        raise UserError(path, f"float {first}", values[first], "finite numbers")
    return DarknetFile(header, values)


def write_darknet(path: Path, content: DarknetFile) -> None:
    """Write a file atomically."""
    write_bytes(path, content.header + content.values.astype("<f4", copy=False).tobytes())


@torch.no_grad()
def fill_slots(slots: Sequence[Slot], content: DarknetFile, path: Path) -> None:
    """Copy the first floats of a file into a network. Output layers with a different number of channels stay unchanged.

    If a variance is negative, raises UserError, whose message names `path`, and copies nothing.
    """
    parts = np.split(content.values[: count_floats(slots)], np.cumsum([slot.floats for slot in slots])[:-1])
    for slot, part in zip(slots, parts, strict=True):
        if slot.name.endswith("variance") and part.min() < 0:
            raise UserError(path, slot.name, part.min(), "a variance of at least 0")
    for slot, part in zip(slots, parts, strict=True):
        if slot.floats == slot.tensor.numel():
            slot.tensor.copy_(torch.from_numpy(part).view(slot.tensor.shape))


def content_of(slots: Sequence[Slot]) -> DarknetFile:
    """File content for a network's tensors, with version 0.2.0 and 0 images seen."""
    values = [slot.tensor.detach().float().cpu().contiguous().flatten().numpy() for slot in slots]
    return DarknetFile(_NEW_HEADER, np.concatenate(values))


def _header_bytes(path: Path, version: bytes) -> int:
    if len(version) < _VERSION.size:
        return 16
    major, minor, revision = _VERSION.unpack(version)
    if min(major, minor, revision) < 0:
        raise UserError(path, "version", f"{major}.{minor}.{revision}", "a Darknet file's header")
    return 20 if major * 10 + minor >= 2 and major < 1000 and minor < 1000 else 16


def _backbone_blocks(backbone: AttentionDarknet53) -> list[Any]:
    blocks: list[Any] = [backbone.stem]
    for i, down in enumerate(backbone.downs):
        blocks.append(down)
        for j in range(UNITS[i]):
            unit: Any = backbone.units[f"B_{i + 1}{j + 1}"]
            blocks += [unit.reduce, unit.expand]
    return blocks


def _numbered(blocks: Sequence[Any], filters: int = _FILTERS) -> list[Slot]:
    """Slots of convolutions with batch norm (`conv_block`) and without batch norm (output layers)."""
    slots = []
    for number, block in enumerate(blocks):
        if hasattr(block, "norm"):
            norm = block.norm
            tensors = (norm.bias, norm.weight, norm.running_mean, norm.running_var, block.conv.weight)
            named = zip(_TENSORS_WITH_NORM, tensors, strict=True)
            slots += [Slot(f"convolution {number} {name}", tensor, tensor.numel()) for name, tensor in named]
        else:
            named = zip(_TENSORS_WITHOUT, (block.bias, block.weight), strict=True)
            slots += [
                Slot(f"convolution {number} {name}", tensor, tensor.numel() // _FILTERS * filters)
                for name, tensor in named
            ]
    return slots
