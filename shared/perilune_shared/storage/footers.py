"""Check the sizes in the untrusted footer of a Parquet file, before anything is decompressed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from perilune_shared.errors import UserError

_MAX_BYTES = 8 * 2**30
_SPARE_BYTES, _MAX_COMPRESSION = 2**26, 200
"""Limits of compression: n bytes may become _SPARE_BYTES + _MAX_COMPRESSION n bytes. Real data compresses less."""
_NESTED_ROWS = "labels."
"""Prefix of the columns of a shard that contain rows of the table `labels`: any number of rows for each frame."""


@dataclass(frozen=True, slots=True)
class FooterLimits:
    """Limits on the number of rows; the defaults are for the tables of a dataset."""

    rows: int = 50_000_000
    """Maximum number of rows of a file."""
    group_rows: int = 2**21
    """Maximum number of rows of a row group."""
    spare_rows: int = 10_000
    """Number of rows allowed whatever the size of the file."""
    bytes_per_row: int = 4
    """Minimum compressed size of each further row, bytes."""


DATASET_LIMITS = FooterLimits()


def check_footer(
    footer: Any, columns: Sequence[tuple[int, str]], n_bytes: int, address: str, limits: FooterLimits | None = None
) -> None:
    """Check the numbers of rows and values and the decompressed size that a footer states.

    `footer` is pyarrow's metadata of the file, `n_bytes` the size of the file, and `columns` has index and path of each
    column that will be read. Without `limits`, the limits of a dataset apply. Raises UserError about `address` if a
    number exceeds its limit, and ValueError if a row group has another number of columns than the file.
    """
    limits = limits or DATASET_LIMITS
    max_rows = min(limits.rows, limits.spare_rows + n_bytes // limits.bytes_per_row)
    max_group_rows = min(limits.group_rows, max_rows)
    n_uncompressed, n_rows = 0, 0
    n_nested: dict[str, int] = {}
    for group in range(footer.num_row_groups):
        rows = footer.row_group(group)
        in_group = rows.num_rows
        n_rows += in_group
        if not 0 <= in_group <= max_group_rows:
            expected = f"at most {max_group_rows} for {n_bytes} bytes"
            raise UserError(address, "rows", f"{in_group} in a row group", expected)
        if rows.num_columns != footer.num_columns:
            raise ValueError(f"a row group of {rows.num_columns} columns, expected {footer.num_columns}")
        for index, path in columns:
            column = rows.column(index)
            n_values = column.num_values
            n_uncompressed += max(column.total_uncompressed_size, 0)
            if path.startswith(_NESTED_ROWS):
                # Each value is a row of a table, so the limit of rows applies.
                n_nested[path] = n_nested.get(path, 0) + n_values
                if n_values > limits.group_rows or n_nested[path] > max_rows:
                    raise UserError(address, path, f"{n_values} values", f"at most {max_rows} for {n_bytes} bytes")
            # In other columns the longest list is a quaternion.
            elif n_values > 4 * in_group:
                raise UserError(address, path, f"{n_values} values", "at most 4 per row")
    if footer.num_rows != n_rows or n_rows > max_rows:
        expected = f"{n_rows}, the sum of the row groups, at most {max_rows} for {n_bytes} bytes"
        raise UserError(address, "rows", footer.num_rows, expected)
    most = min(_MAX_BYTES, _SPARE_BYTES + _MAX_COMPRESSION * n_bytes)
    if n_uncompressed > most:
        found = f"{n_uncompressed} bytes after decompression"
        raise UserError(address, "size", found, f"at most {most} for {n_bytes} bytes")
