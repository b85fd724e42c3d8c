"""One Parquet part of a table: written once, aside and renamed; read with limits, since it may come from anybody.

A part's name says whose rows it holds: `<scene_id>` or `<scene_id>.<trajectory_id>`, or `all` for a whole table, whose
row groups then hold a scene or a few descents each.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from perilune_shared import files
from perilune_shared.errors import UserError
from perilune_shared.schema import SCHEMA_VERSION, TABLES

WHOLE_TABLE = "all"
"""Name of the part that holds all rows of its table."""
_MOST_ROWS = 50_000_000
_LONGEST_TEXT = 1000
_MOST_BYTES = 8 * 2**30
_FOOTER_BYTES = 100_000_000


class Part:
    """An opened part, whose footer has been checked."""

    def __init__(self, path: Path, table: str, schema: pa.Schema | None = None, version: str = SCHEMA_VERSION):
        """Raises UserError where it is no Parquet file, of another table or schema version, or too large.

        `schema` is that of the table's columns where it is not that of TABLES, as in older versions.
        """
        self.path, self.schema = path, schema or TABLES[table]
        texts = [field.name for field in self.schema if pa.types.is_string(field.type)]
        try:
            # As dictionaries, a short file cannot grow into gigabytes of text before its length is known.
            self.file = pq.ParquetFile(
                path,
                read_dictionary=texts,
                thrift_string_size_limit=_FOOTER_BYTES,
                thrift_container_size_limit=_FOOTER_BYTES,
            )
            self.found = pq.ParquetFile(path, metadata=self.file.metadata).schema_arrow
        except (pa.ArrowException, OSError, ValueError) as error:
            raise UserError(path, "content", error, "a whole Parquet file") from None
        metadata = self.found.metadata or {}
        for name, wanted in (("schema_version", version), ("table", table)):
            got = metadata.get(f"perilune.{name}".encode(), b"none").decode(errors="replace")
            if got != wanted:
                hint = "; see `perilune-manifest migrate`" if name == "schema_version" else ""
                raise UserError(path, f"perilune.{name}", got, wanted + hint)
        self._check_size()

    @property
    def n_rows(self) -> int:
        """Rows of the part."""
        return self.file.metadata.num_rows

    def _check_size(self) -> None:
        footer = self.file.metadata
        if footer.num_rows > _MOST_ROWS:
            raise UserError(self.path, "rows", footer.num_rows, f"at most {_MOST_ROWS}")
        n_bytes = 0
        for group in range(footer.num_row_groups):
            rows = footer.row_group(group)
            n_bytes += rows.total_byte_size
            for place in range(rows.num_columns):
                column = rows.column(place)
                # The longest list is a quaternion.
                if column.num_values > 4 * rows.num_rows:
                    raise UserError(self.path, column.path_in_schema, f"{column.num_values} values", "4 a row at most")
                # One image repeated by a dictionary would be a small file that unpacks without end.
                if column.path_in_schema == "image.bytes" and column.has_dictionary_page:
                    raise UserError(self.path, column.path_in_schema, "a dictionary", "plain bytes for each frame")
        if n_bytes > _MOST_BYTES:
            raise UserError(self.path, "size", f"{n_bytes} bytes unpacked", f"at most {_MOST_BYTES}")

    def read(self, columns: Sequence[str] | None = None, groups: Iterable[int] | None = None) -> pa.Table:
        """Rows with chosen columns, of chosen row groups. Raises UserError where that cannot be read."""
        names = list(columns) if columns is not None else self.schema.names
        wanted = pa.schema([self.schema.field(name) for name in names], metadata=self.schema.metadata)
        for field in wanted:
            place = self.found.get_field_index(field.name)
            if place < 0:
                raise UserError(self.path, "columns", f"no {field.name}", f"every column of version {SCHEMA_VERSION}")
            if self.found.field(place).type != field.type:
                raise UserError(self.path, field.name, self.found.field(place).type, f"{field.type}")
        try:
            if groups is None:
                rows = self.file.read(columns=names)
            else:
                rows = self.file.read_row_groups(list(groups), columns=names)
            for field in wanted:
                if pa.types.is_string(field.type):
                    self._check_text(rows[field.name])
            rows = rows.cast(wanted)
            rows.validate(full=True)
            return rows
        except (pa.ArrowException, OSError, ValueError) as error:
            raise UserError(self.path, "content", error, "a whole Parquet file") from None

    def _check_text(self, column: pa.ChunkedArray) -> None:
        for chunk in column.chunks:
            words = chunk.dictionary if pa.types.is_dictionary(chunk.type) else chunk
            longest = pc.max(pc.binary_length(words)).as_py() or 0
            if longest > _LONGEST_TEXT:
                raise UserError(self.path, "text", f"{longest} bytes long", f"at most {_LONGEST_TEXT}")

    def groups_within(self, column: str, low: str, high: str) -> list[int]:
        """Row groups that may hold texts from `low` up to, but not including, `high`, by their statistics."""
        footer = self.file.metadata
        names = [footer.schema.column(i).path for i in range(footer.num_columns)]
        place = names.index(column) if column in names else -1
        chosen = []
        for group in range(footer.num_row_groups):
            known = footer.row_group(group).column(place).statistics if place >= 0 else None
            if known is None or not known.has_min_max or (str(known.min) < high and str(known.max) >= low):
                chosen.append(group)
        return chosen


def read_part(path: Path, table: str, columns: Sequence[str] | None = None) -> pa.Table:
    """One Parquet part. Raises UserError where it cannot be read or is of another table or schema version."""
    return Part(path, table).read(columns)


def write_part(root: Path, table: str, name: str, rows: pa.Table, rows_a_group: int | None = None) -> Path:
    """Write one part `manifest/<table>/<name>.parquet`. A part that exists is never rewritten."""
    part = root / "manifest" / table / f"{name}.parquet"
    if part.exists():
        raise FileExistsError(part)
    with files.written_aside(part) as aside:
        pq.write_table(rows.cast(TABLES[table]), aside, compression="zstd", row_group_size=rows_a_group)
    return part
