"""Compute the decompressed size of a Parquet column from its page headers.

The sizes in the footer are untrusted: a Parquet reader allocates what the page headers state. Headers are in Thrift's
compact protocol, with the fields of parquet.thrift.
"""

from dataclasses import dataclass
from typing import Any, BinaryIO

_HEADER_BYTES = 16_384
_MAX_DEPTH = 4
_DICTIONARY = 2
_BOOLS, _BYTE, _INTEGERS, _DOUBLE, _TEXT, _STRUCT = (1, 2), 3, (4, 5, 6), 7, 8, 12
_TYPE, _UNCOMPRESSED, _COMPRESSED, _DATA, _DATA_V2 = 1, 2, 3, 5, 8


@dataclass(frozen=True, slots=True)
class Pages:
    """Totals over the pages of one column in one row group."""

    uncompressed_bytes: int
    """Size after decompression that the page headers state, bytes."""
    n_values: int
    """Number of values."""
    has_dictionary: bool
    """Whether one of the pages is a dictionary."""


def range_of(column: Any) -> tuple[int, int]:
    """Return the range (start, end) of the pages of a column in the file, bytes; `column` is its metadata."""
    start = column.data_page_offset
    if column.has_dictionary_page and 0 < column.dictionary_page_offset < start:
        start = column.dictionary_page_offset
    return start, start + column.total_compressed_size


def pages_of(stream: BinaryIO, column: Any) -> Pages:
    """Read all page headers of a column from an open file; `column` is pyarrow's column metadata.

    Raises ValueError if a header is damaged.
    """
    start, end = range_of(column)
    uncompressed, n_values, has_dictionary = 0, 0, False
    while start < end and n_values < column.num_values:
        header, length = _header(stream, start)
        sizes = header.get(_UNCOMPRESSED), header.get(_COMPRESSED)
        if not all(isinstance(size, int) and size >= 0 for size in sizes):
            raise ValueError(f"a page at byte {start} without sizes")
        uncompressed += header[_UNCOMPRESSED]
        has_dictionary |= header.get(_TYPE) == _DICTIONARY
        for kind in (_DATA, _DATA_V2):
            n_page_values = header.get(kind, {}).get(1, 0)
            if n_page_values < 0:
                raise ValueError(f"a page at byte {start} with {n_page_values} values")
            n_values += n_page_values
        start += length + header[_COMPRESSED]
    return Pages(uncompressed, n_values, has_dictionary)


def _header(stream: BinaryIO, start: int) -> tuple[dict, int]:
    """Read a page header; return it and its length, bytes."""
    stream.seek(start)
    buffer = stream.read(_HEADER_BYTES)
    try:
        return _struct(buffer, 0, 0)
    except (IndexError, TypeError, AttributeError):
        raise ValueError(f"no page at byte {start}") from None


def _varint(buffer: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = buffer[at]
        value |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return value, at
    raise IndexError


def _struct(buffer: bytes, at: int, depth: int) -> tuple[dict, int]:
    """Parse the integers and structs in a struct; return them by field id, and the offset after the struct.

    Raises IndexError past the end of the buffer.
    """
    if depth > _MAX_DEPTH:
        raise IndexError
    fields: dict[int, Any] = {}
    number = 0
    while buffer[at]:
        kind, step = buffer[at] & 15, buffer[at] >> 4
        at += 1
        if step:
            number += step
        else:
            value, at = _varint(buffer, at)
            number = (value >> 1) ^ -(value & 1)
        if kind in _INTEGERS:
            value, at = _varint(buffer, at)
            fields[number] = (value >> 1) ^ -(value & 1)
        elif kind == _TEXT:
            length, at = _varint(buffer, at)
            at += length
        elif kind == _STRUCT:
            fields[number], at = _struct(buffer, at, depth + 1)
        elif kind in (_BYTE, _DOUBLE):
            at += 1 if kind == _BYTE else 8
        elif kind not in _BOOLS:  # page headers contain no lists
            raise IndexError
    return fields, at + 1
