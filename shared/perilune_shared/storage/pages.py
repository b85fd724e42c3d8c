"""Compute the decompressed size of a Parquet column from its page headers.

A Parquet reader allocates the sizes that the page headers state, and the footer of an untrusted file may state smaller
sizes. Headers are in Thrift's compact protocol, with the fields of parquet.thrift.
"""

from dataclasses import dataclass
from typing import Any, BinaryIO

from perilune_shared.storage.thrift import Fields, parse

_HEADER_BYTES = 16_384
_DICTIONARY = 2
_TYPE, _UNCOMPRESSED, _COMPRESSED, _DATA, _DATA_V2 = 1, 2, 3, 5, 8


@dataclass(frozen=True, slots=True)
class Pages:
    """Totals of the pages of one column in one row group."""

    uncompressed_bytes: int
    """Total size after decompression according to the page headers, bytes."""
    n_values: int
    """Number of values."""
    has_dictionary: bool
    """Whether one of the pages is a dictionary."""


def range_of(column: Any) -> tuple[int, int]:
    """Return the byte range (start, end) of a column's pages; `column` is pyarrow's column metadata."""
    start = column.data_page_offset
    if column.has_dictionary_page and 0 < column.dictionary_page_offset < start:
        start = column.dictionary_page_offset
    return start, start + column.total_compressed_size


def pages_of(stream: BinaryIO, column: Any) -> Pages:
    """Return totals from all page headers of a column; `column` is pyarrow's column metadata.

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
            page = header.get(kind, {})
            n_page_values = page.get(1, 0) if isinstance(page, dict) else None
            if not isinstance(n_page_values, int) or n_page_values < 0:
                raise ValueError(f"a page at byte {start} with {n_page_values} values")
            n_values += n_page_values
        start += length + header[_COMPRESSED]
    return Pages(uncompressed, n_values, has_dictionary)


def _header(stream: BinaryIO, start: int) -> tuple[Fields, int]:
    """Read a page header; return it and its length, bytes."""
    stream.seek(start)
    buffer = stream.read(_HEADER_BYTES)
    try:
        return parse(buffer)
    except ValueError:
        raise ValueError(f"no page at byte {start}") from None
