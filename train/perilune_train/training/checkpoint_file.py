"""Torch checkpoints as untrusted input: check the structure of a file before torch reads its tensors.

A checkpoint is a ZIP with a pickle of plain values and, for each tensor, a file of its numbers. This module reads the
pickle with an allowlist of instructions and names, none of which executes code; tensors become records of their shape.
Torch reads the file only if sizes, names and values are as perilune writes them.
"""

import pickle
import struct
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import torch

from perilune_shared.errors import UserError

MAX_WEIGHT_BYTES, MAX_STATE_BYTES = 2 * 2**30, 12 * 2**30
"""Maximum sizes of a file of weights and of a training state. The weights of a network of width 2 take half of the
first limit; a training state contains four tensors for each weight tensor."""
_MAX_PICKLE_BYTES = 4_000_000
_MAX_DIRECTORY_BYTES = 16_000_000
_MAX_VALUES, _MAX_TEXT_CHARACTERS, _MAX_DEPTH, _MAX_AXES = 1_000_000, 16_000_000, 50, 8
_END, _LOCATOR, _END_64 = struct.Struct("<4s4H2LH"), struct.Struct("<4sLQL"), struct.Struct("<4sQ2H2L4Q")
_ITEM_BYTES = {
    "DoubleStorage": 8,
    "FloatStorage": 4,
    "HalfStorage": 2,
    "BFloat16Storage": 2,
    "LongStorage": 8,
    "IntStorage": 4,
    "ShortStorage": 2,
    "CharStorage": 1,
    "ByteStorage": 1,
    "BoolStorage": 1,
}
# The Python implementation: the C implementation allocates a memo as large as any index in the file.
_Unpickler: Any = vars(pickle)["_Unpickler"]
_INSTRUCTIONS = (
    pickle.PROTO, pickle.STOP, pickle.MARK, pickle.NONE, pickle.NEWTRUE, pickle.NEWFALSE, pickle.BININT,
    pickle.BININT1, pickle.BININT2, pickle.BINFLOAT, pickle.BINUNICODE, pickle.SHORT_BINUNICODE, pickle.EMPTY_LIST,
    pickle.APPEND, pickle.APPENDS, pickle.EMPTY_TUPLE, pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3,
    pickle.EMPTY_DICT, pickle.BINPUT, pickle.LONG_BINPUT, pickle.BINGET, pickle.LONG_BINGET, pickle.GLOBAL,
    pickle.REDUCE, pickle.BINPERSID,
)  # fmt: skip


class _Refused(Exception):
    """Content that perilune does not write."""


@dataclass(frozen=True)
class TensorRecord:
    """Shape of a tensor whose numbers have not been read."""

    shape: tuple[int, ...]
    """Length of each axis."""


@dataclass(frozen=True)
class _Storage:
    """Numbers of tensors, in a file of the ZIP."""

    numbers: int
    """Number of stored numbers."""


def load_checked(path: Path, field: str, expected: str, max_bytes: int) -> Any:
    """Load a checkpoint on the CPU. Raises UserError on anything that perilune does not write.

    Memory and time are bounded by the size of the file, which is at most `max_bytes`.
    """
    size = path.stat().st_size
    if size > max_bytes:
        raise UserError(path, field, f"{size} bytes", f"at most {max_bytes}")
    with path.open("rb") as stream:
        try:
            _check(_read_records(stream, size))
            stream.seek(0)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return torch.load(stream, map_location="cpu", weights_only=True)
        except _Refused as refused:
            raise UserError(path, field, refused, expected) from None
        # Neither zipfile nor torch documents its errors; damaged files raise many types.
        except Exception as error:
            raise UserError(path, field, f"a damaged file ({type(error).__name__})", expected) from None


def check_weights(path: Path, field: str, state: object) -> None:
    """Raise UserError unless a state is a dictionary of named tensors of finite numbers, with variances of at least 0.

    With other numbers, networks would silently compute NaN.
    """
    expected = "finite weights"
    if not isinstance(state, dict):
        raise UserError(path, field, type(state).__name__, "tensors by name")
    for name, tensor in state.items():
        if not isinstance(name, str) or not isinstance(tensor, torch.Tensor):
            raise UserError(path, f"{field}.{name}", type(tensor).__name__, "a tensor")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            wrong = tensor[~torch.isfinite(tensor)]
            got = f"{wrong.numel()} of {tensor.numel()} numbers are not finite; the first is {float(wrong[0])}"
            raise UserError(path, f"{field}.{name}", got, expected)
        if name.endswith("running_var") and tensor.numel() and float(tensor.min()) < 0:
            raise UserError(path, f"{field}.{name}", float(tensor.min()), "a variance of at least 0")


def is_whole(path: Path) -> bool:
    """Whether a file is a complete checkpoint that `load_checked` accepts; reads no tensor."""
    try:
        with path.open("rb") as stream:
            _check(_read_records(stream, path.stat().st_size))
    except Exception:
        return False
    return True


def _read_records(stream: BinaryIO, size: int) -> Any:
    """The pickled values of a checkpoint, its tensors as `TensorRecord`."""
    _check_directory(stream, size)
    with zipfile.ZipFile(stream) as archive:
        entries = archive.infolist()
        names = {entry.filename: entry.file_size for entry in entries}
        if len(names) != len(entries) or len({name.partition("/")[0] for name in names}) != 1:
            raise _Refused("a ZIP with duplicate file names or with several folders")
        if any(e.compress_type != zipfile.ZIP_STORED or e.file_size != e.compress_size for e in entries):
            raise _Refused("a compressed ZIP")
        if sum(names.values()) > size:
            raise _Refused("a ZIP whose files overlap")
        folder = entries[0].filename.partition("/")[0]
        pickled = f"{folder}/data.pkl"
        if names.get(pickled, 0) > _MAX_PICKLE_BYTES:
            raise _Refused(f"a pickle of {names[pickled]} bytes, which is more than {_MAX_PICKLE_BYTES}")
        return _Records(archive.read(pickled), folder, names).load()


def _check_directory(stream: BinaryIO, size: int) -> None:
    """Refuse a file that is not a ZIP, or has a long directory, which `zipfile` would keep in memory."""
    start = max(0, size - _END.size - 2**16)
    stream.seek(start)
    tail = stream.read(_END.size + 2**16)
    end = tail.rfind(b"PK\x05\x06")
    if end < 0 or len(tail) < end + _END.size:
        raise _Refused("not a checkpoint, or a truncated one")
    length = _END.unpack_from(tail, end)[5]
    if length == 0xFFFFFFFF:
        stream.seek(max(0, start + end - _LOCATOR.size))
        stream.seek(_LOCATOR.unpack(stream.read(_LOCATOR.size))[2])
        length = _END_64.unpack(stream.read(_END_64.size))[8]
    if length > _MAX_DIRECTORY_BYTES:
        raise _Refused(f"a ZIP with a directory of {length} bytes, which is more than {_MAX_DIRECTORY_BYTES}")


class _Records(_Unpickler):
    """Reads a pickle with the instructions and names that `torch.save` needs for tensors and plain values."""

    def __init__(self, content: bytes, folder: str, sizes: Mapping[str, int]):
        super().__init__(BytesIO(content))
        self.folder, self.sizes = folder, sizes

    def find_class(self, module: str, name: str) -> Any:
        known = {
            "collections.OrderedDict": _ordered,
            "torch._utils._rebuild_tensor_v2": _tensor,
            "torch._utils._rebuild_parameter": _parameter,
            **{f"torch.{kind}": kind for kind in _ITEM_BYTES},
        }
        if f"{module}.{name}" not in known:
            raise _Refused(f"a file that calls {module}.{name}")
        return known[f"{module}.{name}"]

    def persistent_load(self, pid: Any) -> _Storage:
        kind, storage, key, _, numbers = pid
        stored = self.sizes.get(f"{self.folder}/data/{key}", -1)
        if kind != "storage" or type(numbers) is not int or stored != numbers * _ITEM_BYTES[storage]:
            raise _Refused(f"{numbers} numbers ({storage}) in {max(stored, 0)} bytes")
        return _Storage(numbers)

    def load_long1(self) -> None:
        length = self.read(1)[0]
        if length > 8:
            # Such numbers may have equal hashes, which would make a dictionary slow.
            raise _Refused("an integer of more than 64 bits")
        self.append(pickle.decode_long(self.read(length)))

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set(key, value)

    def load_setitems(self) -> None:
        items = self.pop_mark()
        for key, value in zip(items[::2], items[1::2], strict=True):
            self._set(key, value)

    def load_build(self) -> None:
        state = self.stack.pop()
        # Accept torch's version metadata only: other names would replace methods of the dictionary.
        if not isinstance(self.stack[-1], OrderedDict) or set(state) != {"_metadata"}:
            raise _Refused("an object with attributes")

    def _set(self, key: object, value: object) -> None:
        if type(key) not in (str, int) or not isinstance(self.stack[-1], dict):
            raise _Refused("a dictionary whose keys are neither text nor integers")
        self.stack[-1][key] = value

    dispatch: ClassVar[dict[int, Callable[[Any], None]]] = {
        **{code[0]: _Unpickler.dispatch[code[0]] for code in _INSTRUCTIONS},
        pickle.LONG1[0]: load_long1,
        pickle.SETITEM[0]: load_setitem,
        pickle.SETITEMS[0]: load_setitems,
        pickle.BUILD[0]: load_build,
    }


def _ordered() -> OrderedDict:
    return OrderedDict()


# Takes the arguments of torch's `_rebuild_tensor_v2`, which the pickle calls.
def _tensor(
    storage: _Storage, offset: int, shape: tuple, strides: tuple, grad: bool, hooks: dict, _: object = None
) -> TensorRecord:
    """Refuse a tensor that exceeds its storage or repeats its numbers: its copy would be larger than the file."""
    numbers = (offset, *shape, *strides)
    if not all(type(number) is int and 0 <= number < 2**48 for number in numbers) or len(shape) != len(strides):
        raise _Refused("a tensor with an invalid shape")
    if not isinstance(storage, _Storage) or len(shape) > _MAX_AXES or hooks:
        raise _Refused("a tensor of an unsupported kind")
    last = offset + sum((length - 1) * stride for length, stride in zip(shape, strides, strict=True))
    if prod(shape) > storage.numbers or (prod(shape) and last >= storage.numbers):
        raise _Refused(f"a tensor of {shape} in a storage of {storage.numbers} numbers")
    return TensorRecord(shape)


def _parameter(data: TensorRecord, grad: bool, hooks: dict) -> TensorRecord:
    if not isinstance(data, TensorRecord) or hooks:
        raise _Refused("a parameter of an unsupported kind")
    return data


def _check(content: Any) -> None:
    """Refuse deep nesting, and parts that are referenced so often that their text would fill the memory."""
    values, text, left = 0, 0, [(content, 0)]
    while left:
        value, depth = left.pop()
        values += 1
        text += len(value) if isinstance(value, str) else 0
        if values > _MAX_VALUES or text > _MAX_TEXT_CHARACTERS or depth > _MAX_DEPTH:
            raise _Refused("more values, text or nesting than a checkpoint has")
        if isinstance(value, dict):
            left += [(part, depth + 1) for pair in value.items() for part in pair]
        elif isinstance(value, list | tuple):
            left += [(part, depth + 1) for part in value]
        elif not isinstance(value, TensorRecord | str | int | float | None):
            raise _Refused(f"a value of the type {type(value).__name__}")
