"""Read columns of untrusted Parquet tables, after a check of schema, rows and sizes.

A short file can have any number of rows and texts of any length, since Parquet can repeat a value without further
bytes. Therefore rows and sizes are compared with the limits before anything is decompressed, each distinct text is read
only once, and only one column is in memory besides the result.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.storage.footers import FooterLimits, check_footer
from perilune_shared.storage.pages import pages_of
from perilune_shared.storage.tables.columns import Columns, Kind, Texts, check_present, check_unique
from perilune_shared.storage.tables.limits import (
    BYTES_PER_ROW,
    MAX_TEXT_CHARACTERS,
    MAX_VALUE_CHARACTERS,
    SPARE_ROWS,
    TableLimits,
)

_BATCH_ROWS = 65_536
# Maximum length of lists in a footer. It also limits the depth of the schema: deep nesting can crash the process.
_MAX_LIST = 10_000
_MAX_FOOTER_TEXT_BYTES = 10_000_000
_MAX_METADATA_BYTES = 100_000


class ParquetTable:
    """An open Parquet file whose footer has been checked."""

    def __init__(self, path: Path, limits: TableLimits):
        """Open a file. Raises UserError if it is not a Parquet file or exceeds the limits."""
        self.path, self._limits = path, limits
        self._n_bytes = path.stat().st_size
        self._file = self._open(())
        footer = self._file.metadata
        self._footer_limits = FooterLimits(
            rows=limits.rows, group_rows=limits.rows, spare_rows=SPARE_ROWS, bytes_per_row=BYTES_PER_ROW
        )
        try:
            self._schema = footer.schema.to_arrow_schema()
            check_footer(footer, (), self._n_bytes, str(path), self._footer_limits)
        except (pa.ArrowException, ValueError, KeyError) as error:
            raise self._damaged(error) from None
        self.names: list[str] = [name.strip() for name in self._schema.names]
        self._name_in_file = dict(zip(self.names, self._schema.names, strict=True))
        self.metadata = {
            key.decode(errors="replace"): value.decode(errors="replace")
            for key, value in (self._schema.metadata or {}).items()
            if len(key) + len(value) <= _MAX_METADATA_BYTES
        }
        """Metadata of the schema."""
        self.comments: list[str] = []
        """Always empty; a TextTable has comment lines here."""

    def __enter__(self) -> "ParquetTable":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._file.close()

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self._file.metadata.num_rows

    def peek(self) -> None:
        """Return None; `TextTable.peek` returns the next row."""

    def read(self, columns: Mapping[str, Kind], required: Sequence[str] = ()) -> Columns:
        """Read the given columns; columns that the table lacks are omitted.

        Raises UserError if a `required` column is missing, or a column has another type or is damaged.
        """
        check_present(self.path, self.names, required)
        wanted = [name for name in columns if name in self.names]
        check_unique(self.path, self.names, wanted)
        read: dict[Kind, Callable[[str], Any]] = {
            "number": self._numbers,
            "integer": self._integers,
            "text": self._texts,
        }
        arrays = {}
        try:
            for name in wanted:
                self._check_type(name, columns[name])
            self._check_sizes(wanted)
            for name in wanted:
                arrays[name] = read[columns[name]](name)
        except (pa.ArrowException, OSError, ValueError, KeyError) as error:
            raise self._damaged(error) from None
        return Columns(self.path, arrays, self.n_rows, None)

    def _open(self, texts: Sequence[str]) -> pq.ParquetFile:
        try:
            return pq.ParquetFile(
                self.path,
                read_dictionary=list(texts),
                pre_buffer=False,
                thrift_string_size_limit=_MAX_FOOTER_TEXT_BYTES,
                thrift_container_size_limit=_MAX_LIST,
            )
        except (pa.ArrowException, OSError, ValueError, KeyError) as error:
            raise self._damaged(error) from None

    def _damaged(self, error: Exception) -> UserError:
        return UserError(self.path, "content", error, f"a complete Parquet file with {self._limits.kind}")

    def _check_type(self, name: str, kind: Kind) -> None:
        type_in_file = self._schema.field(self._name_in_file[name]).type
        value = type_in_file.value_type if pa.types.is_dictionary(type_in_file) else type_in_file
        is_number = pa.types.is_integer(value) or pa.types.is_floating(value) or pa.types.is_decimal(value)
        is_text = pa.types.is_string(value) or pa.types.is_large_string(value) or pa.types.is_string_view(value)
        fits = is_number or pa.types.is_null(type_in_file) if kind != "text" else is_text or pa.types.is_integer(value)
        if not fits or (pa.types.is_dictionary(type_in_file) and not is_text):
            expected = {"number": "numbers", "integer": "integers", "text": "texts"}[kind]
            raise UserError(self.path, f"column {name}", type_in_file, expected)

    def _check_sizes(self, names: Sequence[str]) -> None:
        """Check the sizes that footer and page headers state for the columns that will be read."""
        footer = self._file.metadata
        in_file = {self._name_in_file[name] for name in names}
        paths = [footer.schema.column(index).path for index in range(footer.num_columns)]
        columns = [(index, path) for index, path in enumerate(paths) if path.split(".")[0] in in_file]
        check_footer(footer, columns, self._n_bytes, str(self.path), self._footer_limits)
        with self.path.open("rb") as stream:
            for group in range(footer.num_row_groups):
                for index, path in columns:
                    column = footer.row_group(group).column(index)
                    pages = pages_of(stream, column)
                    if pages.uncompressed_bytes > column.total_uncompressed_size or pages.n_values != column.num_values:
                        found = f"{pages.uncompressed_bytes} bytes after decompression and {pages.n_values} values"
                        expected = f"at most {column.total_uncompressed_size} and {column.num_values}, as in the footer"
                        raise UserError(self.path, path, found, expected)

    def _numbers(self, name: str) -> NDArray[np.float64]:
        values = np.full(self.n_rows, np.nan)
        self._fill(name, values, pa.float64())
        return values

    def _integers(self, name: str) -> NDArray[np.int64]:
        values = np.zeros(self.n_rows, np.int64)
        self._fill(name, values, pa.int64())
        return values

    def _fill(self, name: str, values: NDArray, kind: pa.DataType) -> None:
        """Read a column in batches into an array."""
        row = 0
        for batch in self._file.iter_batches(_BATCH_ROWS, columns=[self._name_in_file[name]], use_threads=False):
            column = batch.column(0)
            if kind == pa.int64() and column.null_count:
                n_before = int(np.argmax(np.asarray(column.is_null())))
                raise UserError(self.path, f"{name}: row {row + n_before}", "nothing", "an integer")
            try:
                part = column.cast(kind).to_numpy(zero_copy_only=False)
            except pa.ArrowInvalid as error:
                raise UserError(
                    self.path, f"column {name}", error, "integers" if kind == pa.int64() else "numbers"
                ) from None
            values[row : row + len(part)] = part
            row += len(part)
        if row != len(values):
            raise ValueError(f"{row} values of {name}, expected {len(values)}")

    def _texts(self, name: str) -> Texts:
        in_file = self._name_in_file[name]
        codes = np.full(self.n_rows, -1, np.int32)
        code_of: dict[str, int] = {}
        n_characters = row = 0
        is_text = not pa.types.is_integer(self._schema.field(in_file).type)
        with self._open([in_file] if is_text else ()) as file:
            for group in range(file.num_row_groups):
                for batch in file.iter_batches(_BATCH_ROWS, row_groups=[group], columns=[in_file], use_threads=False):
                    column = batch.column(0)
                    if not is_text:
                        column = column.cast(pa.string())
                    if not pa.types.is_dictionary(column.type):
                        column = column.dictionary_encode()
                    longest = pc.max(pc.binary_length(column.dictionary)).as_py() or 0
                    if longest > MAX_VALUE_CHARACTERS:
                        expected = f"at most {MAX_VALUE_CHARACTERS}"
                        raise UserError(self.path, f"column {name}", f"a text of {longest} bytes", expected)
                    index = np.asarray(column.indices.fill_null(-1), np.int64)
                    used = np.unique(index[index >= 0])
                    numbers = np.full(len(column.dictionary) + 1, -1, np.int32)
                    for at, word in zip(used, column.dictionary.take(pa.array(used)).to_pylist(), strict=True):
                        n_known = len(code_of)
                        numbers[at] = code_of.setdefault(word, n_known) if word else -1
                        n_characters += len(word) if word and numbers[at] == n_known else 0
                    if n_characters > MAX_TEXT_CHARACTERS:
                        found = f"more than {MAX_TEXT_CHARACTERS} characters in different values"
                        raise UserError(self.path, f"column {name}", found, f"at most {MAX_TEXT_CHARACTERS}")
                    codes[row : row + len(index)] = numbers[index]
                    row += len(index)
        return Texts(list(code_of), codes)
