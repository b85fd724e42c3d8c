"""Open an untrusted table and recognise by its content whether it is Parquet or text."""

import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from perilune_shared.errors import UserError
from perilune_shared.storage.tables.columns import Columns, Kind
from perilune_shared.storage.tables.limits import TableLimits
from perilune_shared.storage.tables.text import TextTable

if TYPE_CHECKING:
    from perilune_shared.storage.tables.parquet import ParquetTable

_PARQUET = b"PAR1"
_OTHERS = {
    b"\x1f\x8b": "a gzip file; unpack it",
    b"PK\x03\x04": "a ZIP file or a spreadsheet; unpack it, or save it as CSV",
    b"\xd0\xcf\x11\xe0": "a spreadsheet; save it as CSV",
    b"\xff\xfe": "UTF-16; save it as UTF-8",
    b"\xfe\xff": "UTF-16; save it as UTF-8",
    b"SIMPLE  =": "a FITS file; save it as CSV",
    b"\x89HDF": "an HDF5 file; save it as CSV",
    b"<": "HTML or XML",
    b"{": "JSON",
}
"""First bytes of other file types that users may give instead of a table."""


def open_table(path: Path, limits: TableLimits, header: Sequence[str] | None = None) -> "TextTable | ParquetTable":
    """Open a table and read its header.

    Use the result in a `with` statement: `names` has the column names, and `read` reads columns. `header` gives the
    column names of a text file without a header. Raises UserError if the file is missing, not a regular file, too large
    or of another format.
    """
    expected = f"a CSV or Parquet file with {limits.kind}"
    try:
        state = path.stat()
    except (OSError, ValueError):
        raise UserError(path, "file", "no such file", expected) from None
    if not stat.S_ISREG(state.st_mode):
        found = "a folder" if stat.S_ISDIR(state.st_mode) else "a pipe or a device"
        raise UserError(path, "file", found, expected)
    if state.st_size > limits.file_bytes:
        raise UserError(path, "size", f"{state.st_size} bytes", f"at most {limits.file_bytes} for {limits.kind}")
    try:
        with path.open("rb") as stream:
            start = stream.read(16)
    except OSError as error:
        raise UserError(path, "file", error.strerror, expected) from None
    for magic, found in _OTHERS.items():
        if start.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(magic):
            raise UserError(path, "format", found, expected)
    if start.startswith(_PARQUET):
        # Imported here, since pyarrow takes a second to load.
        from perilune_shared.storage.tables.parquet import ParquetTable

        return ParquetTable(path, limits)
    return TextTable(path, limits, header)


def read_table(
    path: Path, limits: TableLimits, columns: Mapping[str, Kind], required: Sequence[str] | None = None
) -> Columns:
    """Read columns of a table with a header.

    Raises UserError if a column of `required` is missing; by default, all `columns` are required.
    """
    with open_table(path, limits) as table:
        return table.read(columns, list(columns) if required is None else required)
