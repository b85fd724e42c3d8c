"""Parse untrusted structs in Thrift's compact protocol: page headers and footers of Parquet files."""

from collections.abc import Iterator
from typing import Any

_BOOLS, _BYTE, _INTEGERS, _DOUBLE, _TEXT, _LISTS, _STRUCT = (1, 2), 3, (4, 5, 6), 7, 8, (9, 10), 12
_MAX_DEPTH = 8
_LONG = 15
"""In the head of a list, this length means that the actual length follows."""
Fields = dict[int, Any]
"""Field values of a struct, by field number in parquet.thrift; texts are bytes."""


def parse(buffer: bytes, start: int = 0) -> tuple[Fields, int]:
    """Return the struct at the offset `start`, and the offset of its end.

    Raises ValueError if the struct is damaged.
    """
    try:
        fields, end = _struct(buffer, start, 0)
    except IndexError:
        raise ValueError(f"no Thrift struct at byte {start}") from None
    return fields, end


def items_of(buffer: bytes, number: int) -> Iterator[Fields]:
    """Yield the structs of the list in field `number` of a struct, one at a time to limit memory.

    Raises ValueError if the struct is damaged.
    """
    at, field_id = 0, 0
    try:
        while buffer[at]:
            field_id, kind, at = _field_head(buffer, at, field_id)
            if field_id != number:
                _, at = _value(kind, buffer, at, 0)
                continue
            length, inner, at = _list_head(buffer, at)
            for _ in range(length if (kind, inner) == (_LISTS[0], _STRUCT) else 0):
                item, at = _struct(buffer, at, 1)
                yield item
            return
    except IndexError:
        raise ValueError("a damaged Thrift struct") from None


def _field_head(buffer: bytes, at: int, number: int) -> tuple[int, int, int]:
    kind, step = buffer[at] & 15, buffer[at] >> 4
    if step:
        return number + step, kind, at + 1
    value, at = _varint(buffer, at + 1)
    return _signed(value), kind, at


def _list_head(buffer: bytes, at: int) -> tuple[int, int, int]:
    """Return number, type and start offset of the items of a list."""
    length, inner = buffer[at] >> 4, buffer[at] & 15
    if length < _LONG:
        return length, inner, at + 1
    length, at = _varint(buffer, at + 1)
    return length, inner, at


def _varint(buffer: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = buffer[at]
        value |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return value, at
    raise IndexError


def _signed(value: int) -> int:
    return (value >> 1) ^ -(value & 1)


def _value(kind: int, buffer: bytes, at: int, depth: int) -> tuple[Any, int]:
    """Return a value and the offset of its end. Raises IndexError if it extends beyond the buffer."""
    if kind in _INTEGERS:
        value, at = _varint(buffer, at)
        return _signed(value), at
    if kind in _BOOLS:  # the type of a boolean field is the value
        return kind == _BOOLS[0], at
    if kind == _TEXT:
        length, at = _varint(buffer, at)
        return _bytes(buffer, at, length)
    if kind == _STRUCT:
        return _struct(buffer, at, depth + 1)
    if kind in (_BYTE, _DOUBLE):
        return _bytes(buffer, at, 1 if kind == _BYTE else 8)
    if kind in _LISTS:
        length, inner, at = _list_head(buffer, at)
        items = []
        for _ in range(length):
            # Each item takes at least one byte, so a length beyond the buffer causes an IndexError.
            item, at = _bytes(buffer, at, 1) if inner in _BOOLS else _value(inner, buffer, at, depth + 1)
            items.append(item)
        return items, at
    raise IndexError


def _bytes(buffer: bytes, at: int, length: int) -> tuple[bytes, int]:
    if at + length > len(buffer):
        raise IndexError
    return buffer[at : at + length], at + length


def _struct(buffer: bytes, at: int, depth: int) -> tuple[Fields, int]:
    if depth > _MAX_DEPTH:
        raise IndexError
    fields: Fields = {}
    number = 0
    while buffer[at]:
        number, kind, at = _field_head(buffer, at, number)
        fields[number], at = _value(kind, buffer, at, depth)
    return fields, at + 1
