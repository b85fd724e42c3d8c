"""Encode and decode the numbers, texts and errors of PANGU's protocol 1.20.

Integers have 32 bits, most significant byte first. A float is an IEEE 754 word rotated left by 9 bits, so the fraction
comes first, then sign and exponent. A double is rotated left by 12 bits and sent with its low half first.
"""

import struct
from collections.abc import Sequence

import numpy as np

from perilune_render.server.pangu import messages as m
from perilune_shared.geometry.frames import Array

SIZES = {"u": 4, "i": 4, "b": 1, "f": 4, "d": 8}
"""Bytes of each type: unsigned and signed integer, bool, float, double."""


def float_bytes(values: Sequence[float] | np.ndarray) -> bytes:
    """Encode floats (N,). Values beyond the range of a 32-bit float are clipped to its limits.

    Raises ValueError for NaN.
    """
    array = np.asarray(values, np.float64)
    if np.isnan(array).any():
        raise ValueError("NaN cannot be sent")
    largest = np.finfo(np.float32).max
    word = np.clip(array, -largest, largest).astype(np.float32).view(np.uint32)
    return ((word << 9) | (word >> 23)).astype(">u4").tobytes()


def double_bytes(values: Sequence[float] | np.ndarray) -> bytes:
    """Encode doubles (N,). Raises ValueError for values that are not finite."""
    array = np.asarray(values, np.float64)
    if not np.isfinite(array).all():
        raise ValueError("values that are not finite cannot be sent")
    word = array.view(np.uint64)
    turned = (word << np.uint64(12)) | (word >> np.uint64(52))
    halves = np.stack([turned & np.uint64(0xFFFFFFFF), turned >> np.uint64(32)], axis=-1)
    return halves.astype(">u4").tobytes()


def floats_from(data: bytes) -> np.ndarray:
    """Decode floats to float64 (N,), which may be infinite or NaN."""
    word = np.frombuffer(data, ">u4").astype(np.uint32)
    with np.errstate(invalid="ignore"):  # a signalling NaN
        return ((word >> 9) | (word << 23)).view(np.float32).astype(np.float64)


def doubles_from(data: bytes) -> np.ndarray:
    """Decode doubles to float64 (N,), which may be infinite or NaN."""
    halves = np.frombuffer(data, ">u4").astype(np.uint64).reshape(-1, 2)
    word = (halves[:, 1] << np.uint64(32)) | halves[:, 0]
    return ((word >> np.uint64(12)) | (word << np.uint64(52))).view(np.float64)


def unsigned(*values: int) -> bytes:
    """Encode unsigned integers."""
    return struct.pack(f">{len(values)}I", *values)


def text_bytes(text: str) -> bytes:
    """Encode a text in ASCII: its length, the characters, and one or two zeros that make the length even."""
    data = text.encode("ascii", "replace") + b"\0"
    data += b"\0" * (len(data) % 2)
    return struct.pack(">H", len(data)) + data


def read_fields(layout: str, data: bytes) -> list[float | int | bool]:
    """Decode the values of a layout such as "u3f", in which a number repeats the type after it."""
    values: list[float | int | bool] = []
    at = 0
    for kind in expanded(layout):
        part, at = data[at : at + SIZES[kind]], at + SIZES[kind]
        if kind == "f":
            values.append(float(floats_from(part)[0]))
        elif kind == "d":
            values.append(float(doubles_from(part)[0]))
        elif kind == "b":
            values.append(part != b"\0")
        else:
            values.append(int.from_bytes(part, "big", signed=kind == "i"))
    return values


def expanded(layout: str) -> str:
    """A layout without numbers: "u3f" becomes "ufff"."""
    letters, digits = "", ""
    for letter in layout:
        if letter.isdigit():
            digits += letter
        else:
            letters, digits = letters + letter * int(digits or 1), ""
    return letters


def size_of(layout: str) -> int:
    """Number of bytes of a layout."""
    return sum(SIZES[kind] for kind in expanded(layout))


REFUSED, FAULTY = 1, 2
"""Error codes: the server does not support the request; the request has impossible values."""


def error(code: int, text: str) -> bytes:
    """Encode a message of type ERROR; the text is cut to 900 characters."""
    return unsigned(m.ERROR, code) + text_bytes(text[:900] or "error")


def valid_floats(values: Array) -> bytes:
    """Encode floats (N,), each followed by a bool: whether it is valid (finite)."""
    good = np.isfinite(values)
    words = float_bytes(np.where(good, values, 0.0))
    return b"".join(words[4 * k : 4 * k + 4] + (b"\1" if good[k] else b"\0") for k in range(len(values)))


def valid_points(points: Array) -> bytes:
    """Encode points (N, 3), each followed by a bool: whether it is valid (finite)."""
    good = np.isfinite(points).all(axis=1)
    words = float_bytes(np.where(good[:, None], points, 0.0).ravel())
    return b"".join(words[12 * k : 12 * k + 12] + (b"\1" if good[k] else b"\0") for k in range(len(points)))


def doubles(values: Array, *, valid: bool) -> bytes:
    """Encode doubles (N,), each followed by the bool `valid`."""
    words = double_bytes(values)
    return b"".join(words[8 * k : 8 * k + 8] + (b"\1" if valid else b"\0") for k in range(len(values)))


def float_array(values: Array) -> bytes:
    """Encode floats (N,) as a message of type FLOAT_ARRAY; values that are not finite are marked invalid."""
    return unsigned(m.FLOAT_ARRAY, len(values)) + valid_floats(values)
