"""Write Parquet parts of a table atomically; read parts with limits, since they are untrusted input.

The name of a part states which rows it contains: `<scene_id>` or `<scene_id>.<trajectory_id>`. A table in a single file
is the part `all`; each of its row groups contains one scene or a few trajectories. A table with too many rows for one
part continues in `all.0001` and so on.
"""

import contextlib
import errno
import functools
import hashlib
import io
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from pyarrow.fs import LocalFileSystem

from perilune_shared.dataset.names import FRAME_ID_PATTERN, ID_PATTERN, PART_PATTERN, stem_of
from perilune_shared.dataset.schema import MAY_BE_ABSENT, SCHEMA_VERSION, TABLES, stored
from perilune_shared.errors import UserError
from perilune_shared.storage.footers import check_footer
from perilune_shared.storage.pages import pages_of, range_of
from perilune_shared.storage.ranges import Ranges
from perilune_shared.storage.store import Address, Store, open_store
from perilune_shared.storage.thrift import Fields, items_of

MAX_ROWS_WRITTEN = 2_000_000
"""Maximum number of rows of a written part; readers accept this number of rows for every table."""
_MAX_TEXT_BYTES = 1000
# Maximum length of a list in a footer. This also limits the nesting of the schema, which could crash the process.
_MAX_LIST = 10_000
_MAX_FOOTER_TEXT_BYTES = 10_000_000
_FOOTER_END_BYTES = 8
"""Size of the end of the footer: its length and the letters PAR1."""
_ROW_GROUPS = 4
"""Field number of `row_groups` in FileMetaData (parquet.thrift)."""
_SMALL_BYTES, _FEW_WORDS = 2**18, 200
_PARQUET_FILE = re.compile(r"[A-Za-z0-9][^/]*\.parquet", re.DOTALL)
_IDS = {"scene_id": ID_PATTERN, "trajectory_id": ID_PATTERN, "frame_id": FRAME_ID_PATTERN}


@dataclass(frozen=True, slots=True)
class WrittenFile:
    """Path, size and hash of a written file. The hash is of the bytes in memory, not of the disk."""

    path: str
    """Path relative to the dataset."""
    size_bytes: int
    """Size, bytes."""
    sha256: str
    """SHA-256, hexadecimal."""

    @classmethod
    def of(cls, path: str, content: bytes) -> "WrittenFile":
        """Describe a file by its content."""
        return cls(path, len(content), hashlib.sha256(content).hexdigest())


def parquet_files(store: Store, folder: str) -> list[str]:
    """Return the paths of the Parquet files directly in a folder, sorted by name.

    Hidden files are omitted.
    """
    if store.folder is not None:
        local = store.folder / folder
        names = [entry.name for entry in os.scandir(local)] if local.is_dir() else []
    else:
        names = [item.path.removeprefix(f"{folder}/") for item in store.list(folder)]
    return [f"{folder}/{name}" for name in sorted(names, key=lambda name: name[:-8]) if _PARQUET_FILE.fullmatch(name)]


class Part:
    """An open part whose footer has been checked."""

    def __init__(
        self, store: Store, path: str, table: str, schema: pa.Schema | None = None, version: str = SCHEMA_VERSION
    ):
        """Open the part at a path of a store.

        Raises UserError if the file is not Parquet, belongs to another table or schema version, or is too large.

        `schema` replaces the table's schema in TABLES, for older versions and for shards. Unknown columns are ignored.
        Missing columns are read as null if `MAY_BE_ABSENT` lists them.
        """
        self.store, self.path, self.schema = store, path, schema or TABLES[table]
        self.address, self.stem = store.at(path), stem_of(path)
        self._may_be_absent = MAY_BE_ABSENT.get(table, ())
        self._n_bytes = store.plain_size(path)
        self._checked: set[tuple[int, str]] = set()
        try:
            # Read a small file whole; read only the requested columns of a large file.
            self._content = store.read(path, most_bytes=_SMALL_BYTES) if self._n_bytes <= _SMALL_BYTES else None
            self._ranges = None
            if self._content is None and not store.is_local:
                self._ranges = Ranges(functools.partial(store.read, path), self._n_bytes)
                self._ranges.keep(self._n_bytes - _SMALL_BYTES)
            texts = [field.name for field in self.schema if pa.types.is_string(field.type)]
            self.file = self._parquet(texts)
            self.found = self.file.metadata.schema.to_arrow_schema()
            # Store the paths, since each access to pyarrow's metadata creates new objects.
            columns = self.file.metadata.schema
            self._paths = [columns.column(index).path for index in range(len(columns))]
            check_footer(self.file.metadata, self.places_of(self.schema.names), self._n_bytes, self.address)
        except (pa.ArrowException, OSError, ValueError, KeyError) as error:
            raise UserError(self.address, "content", error, "a complete Parquet file") from None
        metadata = self.found.metadata or {}
        for name, expected in (("schema_version", version), ("table", table)):
            got = metadata.get(f"perilune.{name}".encode(), b"none").decode(errors="replace")
            if got != expected:
                hint = "; see `perilune-manifest migrate`" if name == "schema_version" else ""
                raise UserError(self.address, f"perilune.{name}", got, expected + hint)

    def _parquet(self, texts: Sequence[str]) -> pq.ParquetFile:
        """Open the file; read the columns `texts` as dictionaries.

        Without dictionaries, a short file could decompress to gigabytes of text before the length of the texts is
        checked.
        """
        source = self._source()
        options = {
            "pre_buffer": False,
            "thrift_string_size_limit": _MAX_FOOTER_TEXT_BYTES,
            "thrift_container_size_limit": _MAX_LIST,
        }
        with contextlib.suppress(KeyError):  # a text column that the file lacks
            return pq.ParquetFile(source, read_dictionary=texts, **options)
        with pq.ParquetFile(source, **options) as plain:
            names = plain.metadata.schema.names
        return pq.ParquetFile(source, read_dictionary=[name for name in texts if name in names], **options)

    def _source(self) -> Any:
        """Return a source for pyarrow: the bytes of a small file, a local path, or an object read by ranges."""
        if self._content is not None:
            return pa.BufferReader(self._content)
        return self._ranges if self.store.folder is None else self.store.folder / self.path

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self.file.metadata.num_rows

    @property
    def n_groups(self) -> int:
        """Number of row groups."""
        return self.file.metadata.num_row_groups

    def stated_groups(self) -> Iterator[Fields]:
        """Yield each row group's RowGroup struct from the footer. Raises UserError if the footer is damaged."""
        try:
            with self._bytes_of([], []) as stream:
                stream.seek(self._n_bytes - _FOOTER_END_BYTES)
                start = self._n_bytes - _FOOTER_END_BYTES - int.from_bytes(stream.read(4), "little")
                stream.seek(start)
                footer = stream.read(self._n_bytes - _FOOTER_END_BYTES - start)
            yield from items_of(footer, _ROW_GROUPS)
        except (OSError, ValueError) as error:
            raise UserError(self.address, "content", error, "a complete Parquet file") from None

    def places_of(self, names: Iterable[str]) -> list[tuple[int, str]]:
        """Return position and path of each column of the file that belongs to one of the named fields."""
        wanted = set(names)
        return [(index, path) for index, path in enumerate(self._paths) if path.split(".")[0] in wanted]

    def read(
        self, columns: Sequence[str] | None = None, groups: Iterable[int] | None = None, *, any_ids: bool = False
    ) -> pa.Table:
        """Read columns of row groups; by default all columns and all groups.

        Raises UserError if the rows cannot be read, or if an id of a scene, trajectory or frame is not a safe file
        name. `any_ids` skips the check of ids.
        """
        chosen = list(range(self.n_groups) if groups is None else groups)
        names = list(columns) if columns is not None else self.schema.names
        schema = pa.schema([self.schema.field(name) for name in names], metadata=self.schema.metadata)
        missing = [name for name in names if name in self._may_be_absent and name not in self.found.names]
        present = [name for name in names if name not in missing]
        for field in map(schema.field, present):
            index = self.found.get_field_index(field.name)
            if index < 0:
                raise UserError(
                    self.address, "columns", f"no {field.name}", f"every column of version {SCHEMA_VERSION}"
                )
            if self.found.field(index).type != field.type:
                raise UserError(self.address, field.name, self.found.field(index).type, f"{field.type}")
        try:
            with self._bytes_of(chosen, present) as stream:
                for group in chosen:
                    self._check_pages(stream, group, present)
                # Threads slow down the reading of a single row group.
                rows = self.file.read_row_groups(chosen, columns=present, use_threads=len(chosen) > 1)
            for field in map(schema.field, present):
                if pa.types.is_string(field.type):
                    self._check_text(field.name, rows[field.name], None if any_ids else _IDS.get(field.name))
            for name in missing:
                n_rows = sum(self.file.metadata.row_group(group).num_rows for group in chosen)
                rows = rows.append_column(name, pa.nulls(n_rows, schema.field(name).type))
            rows = rows.select(names).cast(schema)
            rows.validate(full=True)
            return rows
        except (pa.ArrowException, OSError, ValueError, KeyError) as error:
            raise UserError(self.address, "content", error, "a complete Parquet file") from None

    @contextlib.contextmanager
    def _bytes_of(self, groups: list[int], names: list[str]) -> Iterator[BinaryIO]:
        """Open the file to read columns of row groups; in an object store, first fetch all their bytes."""
        if self._ranges is None:
            with self.store.open(self.path) if self._content is None else io.BytesIO(self._content) as stream:
                yield stream
            return
        columns = [
            range_of(row_group.column(index))
            for row_group in map(self.file.metadata.row_group, groups)
            for index, _ in self.places_of(names)
        ]
        with self._ranges.fetched(columns):
            yield cast(BinaryIO, self._ranges)

    def _check_pages(self, stream: BinaryIO, group: int, names: list[str]) -> None:
        """Check that pages do not exceed the sizes in the footer; the footer was checked on opening."""
        metadata = self.file.metadata.row_group(group)
        for index, name in self.places_of(names):
            if (group, name) in self._checked:
                continue
            column = metadata.column(index)
            pages = pages_of(stream, column)
            if pages.uncompressed_bytes > column.total_uncompressed_size or pages.n_values != column.num_values:
                found = f"{pages.uncompressed_bytes} bytes after decompression and {pages.n_values} values"
                expected = f"at most {column.total_uncompressed_size} and {column.num_values}, as in the footer"
                raise UserError(self.address, name, found, expected)
            # Refuse a dictionary of images: a small file could repeat one image and decompress to any size.
            if name.startswith("image.") and pages.has_dictionary:
                raise UserError(self.address, name, "a dictionary", "plain bytes for each frame")
            self._checked.add((group, name))

    def _check_text(self, name: str, column: pa.ChunkedArray, pattern: str | None) -> None:
        for chunk in column.chunks:
            words = chunk.dictionary if pa.types.is_dictionary(chunk.type) else chunk
            longest = pc.max(pc.binary_length(words)).as_py() or 0
            if longest > _MAX_TEXT_BYTES:
                raise UserError(self.address, name, f"text of {longest} bytes", f"at most {_MAX_TEXT_BYTES}")
            mismatch = _first_mismatch(words, pattern) if pattern is not None else None
            if mismatch is not None:
                raise UserError(self.address, name, repr(mismatch), f"text like {pattern}")

    def groups_within(self, column: str, low: str, high: str) -> list[int]:
        """Return the row groups that may contain texts in [low, high), according to their statistics."""
        footer = self.file.metadata
        names = [footer.schema.column(i).path for i in range(footer.num_columns)]
        index = names.index(column) if column in names else -1
        chosen = []
        for group in range(footer.num_row_groups):
            stated = footer.row_group(group).column(index).statistics if index >= 0 else None
            try:
                excluded = (
                    stated is not None
                    and stated.has_min_max
                    and not (str(stated.min) < high and str(stated.max) >= low)
                )
            except (pa.ArrowException, ValueError):  # statistics of another type, or not UTF-8
                excluded = False
            if not excluded:
                chosen.append(group)
        return chosen

    def groups_where(self, condition: pc.Expression) -> list[int]:
        """Return the row groups that may contain rows that fulfil a condition, by their statistics."""
        try:
            # The footer was checked when the part was opened.
            source, local = self._source(), None
            if isinstance(source, Path):
                source, local = str(source.absolute()), LocalFileSystem()
            whole = ds.ParquetFileFormat().make_fragment(source, local)
            return [group.id for group in whole.subset(filter=condition, schema=self.schema).row_groups]
        except (pa.ArrowException, ValueError, KeyError):
            return list(range(self.n_groups))


def _first_mismatch(words: pa.Array, pattern: str) -> str | None:
    """Return the first text that does not match a pattern, or None if all match."""
    if len(words) <= _FEW_WORDS:  # faster for few texts, since Arrow compiles the pattern in every call
        fitting = re.compile(pattern)
        return next((word for word in words.to_pylist() if word is not None and not fitting.fullmatch(word)), None)
    fits = pc.match_substring_regex(words, pattern)  # in RE2, $ matches only at the end of the text
    return words.filter(pc.invert(fits))[0].as_py() if pc.all(fits).as_py() is False else None


def write_part(
    address: Address,
    table: str,
    name: str,
    rows: pa.Table,
    rows_per_group: int | None = None,
    *,
    replace: bool = False,
) -> WrittenFile:
    """Write the part `manifest/<table>/<name>.parquet` of a dataset.

    Raises FileExistsError if the file exists, unless `replace` is true. Raises UserError if `name` is not a valid part
    name, since `name` may come from an untrusted dataset.
    """
    store = open_store(address)
    if not re.fullmatch(PART_PATTERN, name) or name.endswith("\n"):
        raise UserError(store, "part", repr(name), f"a name like {PART_PATTERN}")
    path = f"manifest/{table}/{name}.parquet"
    if not replace and store.exists(path):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), store.at(path))
    sink = pa.BufferOutputStream()
    pq.write_table(stored(table, rows), sink, compression="zstd", row_group_size=rows_per_group)
    content = sink.getvalue().to_pybytes()
    if replace:
        store.replace(path, content)
    else:
        store.write(path, content)
    return WrittenFile.of(path, content)
