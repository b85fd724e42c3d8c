"""Weights as a safetensors file in half precision: small, and loading it executes nothing."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load, save

from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_bytes

SUFFIX = ".safetensors"
_PLAIN = ("architecture", "terrain")
"""Keys of a checkpoint that are stored as JSON in the header; `terrain` may be missing."""


def write_half(path: Path, content: Mapping[str, Any]) -> None:
    """Write the content of a checkpoint (`runs.load_weights`) in half precision.

    Only convolutions and matrices are halved. Vectors, such as the variances of norms, and buffers keep their type:
    they are few and may exceed the range of half precision. Raises UserError if a weight does.
    """
    tensors = {}
    for name, tensor in content["state_dict"].items():
        halved = tensor.half() if name.endswith(".weight") and tensor.ndim >= 2 else tensor
        if not bool(torch.isfinite(halved).all()):
            raise UserError(path, name, "a weight above 65504", "weights in the range of half precision")
        tensors[name] = halved.contiguous()
    metadata = {key: json.dumps(content[key], separators=(",", ":")) for key in _PLAIN if key in content}
    write_bytes(path, save(tensors, metadata))


def read_half(path: Path) -> dict[str, Any]:
    """The content that `write_half` wrote, weights as float32, on the CPU. Raises UserError on any other file."""
    expected = "a file of weights that perilune wrote"
    try:
        with safetensors.safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
        content = {key: json.loads(metadata[key]) for key in _PLAIN if key in metadata}
        tensors = load(path.read_bytes())
    except (safetensors.SafetensorError, ValueError, RecursionError, OSError) as error:
        raise UserError(path, "weights", str(error) or type(error).__name__, expected) from None
    if not isinstance(content.get("architecture"), dict):
        raise UserError(path, "architecture", "missing", expected)
    content["state_dict"] = {key: t.float() if t.dtype == torch.float16 else t for key, t in tensors.items()}
    return content
