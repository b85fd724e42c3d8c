"""Weights as a small safetensors file, in half precision or 8 bits. Loading it executes no code."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load, save

from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_bytes
from perilune_train.training.checkpoint_file import MAX_WEIGHT_BYTES

SUFFIX = ".safetensors"
_MAX_HEADER_BYTES = 8_000_000
_DTYPES = {"F16", "F32", "F64", "I64", "I32", "I8", "BOOL"}
_STEP = "#step"
"""Suffix in the name of the tensor that holds the quantisation steps of an 8-bit tensor."""
_PLAIN = ("architecture", "terrain")
"""Keys of a checkpoint whose values are stored as JSON in the header; `terrain` may be missing."""


def write_half(path: Path, content: Mapping[str, Any]) -> None:
    """Write the content of a checkpoint (`runs.load_weights`) in half precision.

    Only convolutions and matrices are converted. Vectors, such as the variances of norms, and buffers keep their type,
    because they are few and may exceed the range of half precision. Raises UserError if a converted weight exceeds this
    range.
    """
    tensors = {}
    for name, tensor in content["state_dict"].items():
        halved = tensor.half() if _is_rounded(name, tensor) else tensor
        if not bool(torch.isfinite(halved).all()):
            raise UserError(path, name, "a weight above 65504", "weights in the range of half precision")
        tensors[name] = halved.contiguous()
    _write(path, tensors, content)


def write_bytewise(path: Path, content: Mapping[str, Any]) -> None:
    """Write the content of a checkpoint with 8 bits per weight, half the size of `write_half`.

    Only convolutions and matrices are rounded, as in `write_half`. Each output channel has a step (float32). A weight
    of the channel becomes an integer from -127 to 127, in units of this step. Raises UserError if a weight is not
    finite.
    """
    tensors = {}
    for name, tensor in content["state_dict"].items():
        if not bool(torch.isfinite(tensor).all()):
            raise UserError(path, name, "a weight that is not finite", "finite weights")
        if _is_rounded(name, tensor):
            flat = tensor.float().flatten(1)
            # Any positive step is correct for a channel of zeros.
            step = (flat.abs().amax(1) / 127).clamp(min=torch.finfo(torch.float32).tiny)
            tensors[name] = torch.round(flat / step[:, None]).to(torch.int8).view(tensor.shape).contiguous()
            tensors[name + _STEP] = step
        else:
            tensors[name] = tensor.contiguous()
    _write(path, tensors, content)


def _is_rounded(name: str, tensor: torch.Tensor) -> bool:
    # torch names the matrices of an LSTM weight_ih_l0, weight_hh_l0 and so on.
    return tensor.ndim >= 2 and name.rpartition(".")[2].startswith("weight")


def _write(path: Path, tensors: dict[str, torch.Tensor], content: Mapping[str, Any]) -> None:
    metadata = {key: json.dumps(content[key], separators=(",", ":")) for key in _PLAIN if key in content}
    write_bytes(path, save(tensors, metadata))


def read_half(path: Path) -> dict[str, Any]:
    """Read a file of `write_half` or `write_bytewise`; return the content with weights as float32 on the CPU.

    Raises UserError on any other file.
    """
    expected = "a file of weights that perilune wrote"
    try:
        _check_header(path, expected)
        with safetensors.safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            kinds = {file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118
        content = {key: json.loads(metadata[key]) for key in _PLAIN if key in metadata}
        if not kinds <= _DTYPES:
            raise UserError(path, "weights", f"numbers of type {', '.join(sorted(kinds - _DTYPES))}", expected)
        tensors = load(path.read_bytes())
    except (safetensors.SafetensorError, ValueError, RecursionError, OSError, KeyError) as error:
        raise UserError(path, "weights", str(error) or type(error).__name__, expected) from None
    if not isinstance(content.get("architecture"), dict):
        raise UserError(path, "architecture", "missing", expected)
    content["state_dict"] = _as_float32(path, tensors)
    return content


def _as_float32(path: Path, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Convert tensors to float32. Raises UserError if 8-bit tensors and their steps do not match."""
    steps = {name.removesuffix(_STEP): tensors.pop(name) for name in list(tensors) if name.endswith(_STEP)}
    for name in {key for key, tensor in tensors.items() if tensor.dtype == torch.int8} | set(steps):
        whole, step = tensors.get(name), steps.get(name)
        if whole is None or step is None or whole.dtype != torch.int8 or whole.ndim < 2:
            raise UserError(path, name, "integers without steps, or the reverse", "both, for a tensor of weights")
        if step.dtype != torch.float32 or step.shape != whole.shape[:1]:
            got = f"steps of shape {list(step.shape)}, {step.dtype}"
            raise UserError(path, name, got, f"{whole.shape[0]} of torch.float32")
        tensors[name] = whole.float() * step.view(-1, *[1] * (whole.ndim - 1))
    return {key: tensor.float() if tensor.dtype == torch.float16 else tensor for key, tensor in tensors.items()}


def precision_of(path: Path) -> str:
    """How a file stores its weights, as text for users: half precision or 8 bits per weight."""
    with safetensors.safe_open(path, "pt") as file:
        bytewise = any(file.get_slice(name).get_dtype() == "I8" for name in file.keys())  # noqa: SIM118
    return "8 bits per weight" if bytewise else "half precision"


def is_whole(path: Path) -> bool:
    """Whether a file is a complete safetensors file. No tensor is read."""
    try:
        _check_header(path, "")
        # The library rejects a file whose size differs from the total size of its header and tensors.
        with safetensors.safe_open(path, "pt"):
            return True
    except (safetensors.SafetensorError, UserError, OSError):
        return False


def _check_header(path: Path, expected: str) -> None:
    """Reject a file or a header that exceeds the size limits, before the library reads it."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        header = int.from_bytes(stream.read(8), "little")
    if size > MAX_WEIGHT_BYTES:
        raise UserError(path, "weights", f"{size} bytes", f"at most {MAX_WEIGHT_BYTES}")
    if header > min(_MAX_HEADER_BYTES, size):
        raise UserError(path, "weights", f"a header of {header} bytes", expected)
