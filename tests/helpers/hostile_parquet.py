"""Forge Parquet files that no writer makes: parse and write their footers (Thrift, compact protocol)."""

import struct
from collections.abc import Callable
from pathlib import Path

_BOOLS, _BYTE, _INTEGERS, _DOUBLE, _TEXT, _LISTS, _STRUCT = (1, 2), 3, (4, 5, 6), 7, 8, (9, 10), 12
Fields = dict[int, tuple[int, object]]
"""Type and value of the fields of a struct, by field number of parquet.thrift."""


def _varint(buffer: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = buffer[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _as_varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _read(kind: int, buffer: bytes, at: int) -> tuple[object, int]:
    if kind in _BOOLS:
        return kind == 1, at
    if kind in _INTEGERS:
        value, at = _varint(buffer, at)
        return (value >> 1) ^ -(value & 1), at
    if kind == _TEXT:
        length, at = _varint(buffer, at)
        return buffer[at : at + length], at + length
    if kind in (_BYTE, _DOUBLE):
        length = 1 if kind == _BYTE else 8
        return buffer[at : at + length], at + length
    if kind in _LISTS:
        head, at = buffer[at], at + 1
        length = head >> 4
        if length == 15:
            length, at = _varint(buffer, at)
        items = []
        for _ in range(length):
            if head & 15 in _BOOLS:
                value, at = buffer[at], at + 1
            else:
                value, at = _read(head & 15, buffer, at)
            items.append(value)
        return (head & 15, items), at
    assert kind == _STRUCT, kind
    fields: Fields = {}
    number = 0
    while buffer[at]:
        head, at = buffer[at], at + 1
        if head >> 4:
            number += head >> 4
        else:
            value, at = _varint(buffer, at)
            number = (value >> 1) ^ -(value & 1)
        value, at = _read(head & 15, buffer, at)
        fields[number] = head & 15, value
    return fields, at + 1


def _written(kind: int, value) -> bytes:
    if kind in _BOOLS:
        return b""
    if kind in _INTEGERS:
        return _as_varint((value << 1) ^ (value >> 63))
    if kind == _TEXT:
        return _as_varint(len(value)) + value
    if kind in (_BYTE, _DOUBLE):
        return value
    if kind in _LISTS:
        inner, items = value
        parts = [bytes([item]) if inner in _BOOLS else _written(inner, item) for item in items]
        return bytes([0xF0 | inner]) + _as_varint(len(items)) + b"".join(parts)
    out = b""
    for number, (inner, content) in value.items():
        head = (1 if content else 2) if inner in _BOOLS else inner
        out += bytes([head]) + _as_varint(number << 1) + _written(inner, content)
    return out + b"\0"


def forge(path: Path, change: Callable[[Fields], None]) -> None:
    """Rewrite a Parquet file's footer with `change` applied to its FileMetaData."""
    whole = path.read_bytes()
    (length,) = struct.unpack("<I", whole[-8:-4])
    footer, _ = _read(_STRUCT, whole[-8 - length : -8], 0)
    change(footer)
    again = _written(_STRUCT, footer)
    path.write_bytes(whole[: -8 - length] + again + struct.pack("<I", len(again)) + b"PAR1")


def put(fields: Fields, number: int, value: object) -> None:
    """Replace the value of a field and keep its type."""
    fields[number] = fields[number][0], value


def groups(footer: Fields) -> list[Fields]:
    """Return the row groups: 1 columns, 2 total_byte_size, 3 num_rows."""
    return footer[4][1][1]


def columns(group: Fields) -> list[Fields]:
    """Return the metadata of the columns: 5 num_values, 6 and 7 decompressed and compressed bytes, 9 to 11 offsets."""
    return [chunk[3][1] for chunk in group[1][1][1]]


def nested(depth: int) -> bytes:
    """Return a file without rows whose schema is nested to a depth."""
    group = {3: (5, 0), 4: (8, b"a"), 5: (5, 1)}
    leaf = {1: (5, 1), 3: (5, 0), 4: (8, b"z")}
    footer = {1: (5, 2), 2: (9, (12, [group] * depth + [leaf])), 3: (6, 0), 4: (9, (12, []))}
    content = _written(_STRUCT, footer)
    return b"PAR1" + content + struct.pack("<I", len(content)) + b"PAR1"
