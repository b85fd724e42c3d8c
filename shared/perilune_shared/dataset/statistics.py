"""Compare the statistics in the footer of a Parquet part with its values.

Readers skip row groups by these statistics, so a false statistic hides rows. This module parses the footer itself,
since pyarrow ignores some statistics that other programs use: those in the older fields for minimum and maximum, and
those of certain writers.
"""

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.dataset.parts import Part
from perilune_shared.errors import UserError
from perilune_shared.storage.thrift import Fields

# Field numbers of parquet.thrift.
_COLUMNS, _METADATA, _PATH, _N_VALUES, _STATISTICS = 1, 3, 3, 5, 12
_NULLS, _DISTINCT = 3, 4
_EXTREMES = {1: "max", 2: "min", 5: "max", 6: "min"}
_OF_GROUP = {4: "a sort order"}
_OF_CHUNK = {1: "values in another file", 4: "a page index", 6: "a page index"}
_OF_COLUMN = {14: "a Bloom filter"}
"""Further footer entries by which programs select or find rows. No version of perilune writes them."""
_BYTES = {pa.int64(): "<i8", pa.int32(): "<i4", pa.float64(): "<f8", pa.float32(): "<f4", pa.bool_(): "?"}


def false_statistics(part: Part, stated: Fields, rows: pa.Table) -> Iterator[UserError]:
    """Yield an error for each false statistic of a row group, and for each entry that cannot be checked.

    `stated` is the RowGroup struct in the footer; `rows` has the columns to check, with all rows of the group. Bloom
    filters are an example of entries that cannot be checked.
    """
    for number in _OF_GROUP.keys() & stated.keys():
        yield UserError(part.address, "row group", _OF_GROUP[number], "none")
    chunks = stated.get(_COLUMNS, [])
    for name in rows.column_names:
        columns = part.places_of([name])
        leaves = _leaves(rows[name].combine_chunks()) if columns else ()
        for (index, path), leaf in zip(columns, leaves, strict=False):
            try:
                yield from _false_of_column(part.address, path, chunks[index], leaf)
            except (TypeError, KeyError, IndexError, AttributeError, ValueError):
                yield UserError(part.address, path, "a damaged description in the footer", "a complete Parquet file")


def _leaves(column: pa.Array) -> Iterator[pa.Array]:
    """Yield the arrays that Parquet stores as columns, in its order, without elements of null lists."""
    if pa.types.is_struct(column.type):
        for index in range(column.type.num_fields):
            yield from _leaves(pc.struct_field(column, index))
    elif pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
        yield from _leaves(column.flatten())
    else:
        yield column


def _false_of_column(address: str, path: str, chunk: Fields, values: pa.Array) -> Iterator[UserError]:
    """Yield an error for each false statistic of a column; `chunk` is its ColumnChunk in the footer."""
    metadata = chunk[_METADATA]
    for notes, fields in ((_OF_CHUNK, chunk), (_OF_COLUMN, metadata)):
        for number in sorted(notes.keys() & fields.keys()):
            yield UserError(address, path, notes[number], "none")
    if (own_path := b".".join(metadata[_PATH])) != path.encode():
        yield UserError(address, path, f"the name {own_path.decode(errors='replace')}", f"{path}, as in the schema")
    statistics = metadata.get(_STATISTICS, {})
    n_present = len(values) - values.null_count
    if _NULLS in statistics and metadata[_N_VALUES] - statistics[_NULLS] != n_present:
        expected = f"{metadata[_N_VALUES] - n_present}, from the values"
        yield UserError(address, path, f"{statistics[_NULLS]} nulls in the statistics", expected)
    if _DISTINCT in statistics and statistics[_DISTINCT] != (distinct := pc.count_distinct(values).as_py()):
        found = f"{statistics[_DISTINCT]} distinct values in the statistics"
        yield UserError(address, path, found, f"{distinct}, from the values")
    if not _EXTREMES.keys() & statistics.keys():
        return
    extremes = pc.min_max(values).as_py()
    for number in sorted(_EXTREMES.keys() & statistics.keys()):
        name = _EXTREMES[number]
        stated, actual = _value(statistics[number], values.type), extremes[name]
        if actual is None or stated != actual:
            expected = f"{actual if n_present else 'none'}, from the values"
            yield UserError(address, path, f"{name} {stated} in the statistics", expected)


def _value(raw: bytes, kind: pa.DataType) -> object:
    """Decode a value of the statistics. Raises ValueError if its length does not fit its type."""
    if pa.types.is_string(kind):
        return raw.decode(errors="replace")
    if pa.types.is_binary(kind):
        return raw
    (value,) = np.frombuffer(raw, _BYTES[kind])
    return value.item()
