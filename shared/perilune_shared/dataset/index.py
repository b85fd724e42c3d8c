"""The index of a dataset: path, size and SHA-256 of every file except dataset.json and the index.

dataset.json names the parts of the index with their hashes. The name of a part is derived from its content, so a new
index never overwrites the old one; dataset.json states which one is valid.
"""

import hashlib
from collections.abc import Iterable, Sequence

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from perilune_shared.dataset.info_file import INFO_NAME, write_info
from perilune_shared.dataset.metadata import DatasetInfo, IndexPart
from perilune_shared.dataset.names import IMAGE_KINDS, SCENE_FILE_KINDS
from perilune_shared.dataset.parts import Part, WrittenFile
from perilune_shared.dataset.schema import SCHEMA_VERSION
from perilune_shared.dataset.statistics import false_statistics
from perilune_shared.errors import UserError
from perilune_shared.storage import files
from perilune_shared.storage.store import Store

FOLDER = "index"
INDEX = pa.schema(
    [
        pa.field("path", pa.string(), nullable=False, metadata={"unit": "", "meaning": "relative to the dataset"}),
        pa.field("bytes", pa.int64(), nullable=False, metadata={"unit": "B", "meaning": "file size"}),
        pa.field("sha256", pa.string(), nullable=False, metadata={"unit": "", "meaning": "of the whole file"}),
    ],
    metadata={"perilune.table": FOLDER, "perilune.schema_version": SCHEMA_VERSION},
)
"""Schema of the index."""
MAX_ROWS = 2_000_000
"""Maximum number of rows of a part."""
MAX_TOTAL_ROWS = 4_000_000
"""Maximum number of rows of all parts; a row takes about 0.4 kB of memory while files are checked."""
LARGEST_FILE_BYTES = 2**36
_ROWS_PER_GROUP = 2**16
_LONGEST_PATH = 500
_PATH = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,199}(/[A-Za-z0-9][A-Za-z0-9._-]{0,199})*$"
_SHA256 = r"^[0-9a-f]{64}$"


def index_rows(written: Iterable[WrittenFile]) -> pa.Table:
    """Return the index rows of written files, sorted by path."""
    files = sorted(written, key=lambda file: file.path)
    columns = [[file.path for file in files], [file.size_bytes for file in files], [file.sha256 for file in files]]
    return pa.table(columns, schema=INDEX)


def frame_rows(frames: pa.Table) -> pa.Table:
    """Return the index rows of all files named in the table `frames`, by kind, then by row of frames.

    Raises UserError if a frame has a path without size or hash.
    """
    return _named_files(frames, "frames", IMAGE_KINDS)


def scene_file_rows(scenes: pa.Table) -> pa.Table:
    """Return the index rows of all files named in the table `scenes`.

    Raises UserError if a scene has a path without size or hash.
    """
    return _named_files(scenes, "scenes", SCENE_FILE_KINDS)


def _named_files(table: pa.Table, name: str, kinds: Sequence[str]) -> pa.Table:
    pieces = [INDEX.empty_table()]
    for kind in kinds:
        of_kind = table.filter(pc.is_valid(table[f"{kind}_path"]))
        columns = [of_kind[f"{kind}_{column}"] for column in ("path", "bytes", "sha256")]
        if any(column.null_count for column in columns):
            raise UserError(name, f"{kind}_sha256", "null", f"size and SHA-256 of every {name.removesuffix('s')}")
        pieces.append(
            pa.table([column.cast(field.type) for column, field in zip(columns, INDEX, strict=True)], schema=INDEX)
        )
    return pa.concat_tables(pieces)


def write_index(store: Store, rows: pa.Table) -> tuple[IndexPart, ...]:
    """Write the parts of an index from rows in any order; return their records for dataset.json."""
    if len(rows) > MAX_TOTAL_ROWS:
        expected = f"at most {MAX_TOTAL_ROWS}; pack the frames, or split the dataset"
        raise UserError(store, "files", len(rows), expected)
    rows = rows.sort_by("path")
    parts = []
    for start in range(0, max(len(rows), 1), MAX_ROWS):
        sink = pa.BufferOutputStream()
        chosen = rows[start : start + MAX_ROWS].cast(INDEX)
        pq.write_table(chosen, sink, compression="zstd", use_dictionary=False, row_group_size=_ROWS_PER_GROUP)
        content = sink.getvalue().to_pybytes()
        sha256 = hashlib.sha256(content).hexdigest()
        parts.append(IndexPart(path=f"{FOLDER}/{sha256[:16]}.parquet", bytes=len(content), sha256=sha256))
        store.replace(parts[-1].path, content)
    return tuple(parts)


def seal(store: Store, info: DatasetInfo, rows: pa.Table) -> DatasetInfo:
    """Write the index, then dataset.json, then delete older indexes; return the content of dataset.json.

    If all files of the older index are unchanged, the dataset matches its index at every moment.
    """
    info = info.model_copy(update={"index": write_index(store, rows)})
    write_info(store, info)
    named = {part.path for part in info.index}
    for item in [*store.list(FOLDER)]:
        if item.path not in named and files.is_plain(item.path):
            store.delete(item.path)
    return info


def read_index(store: Store, info: DatasetInfo) -> pa.Table:
    """Read the index, sorted by path. All paths are plain, unique and inside the dataset.

    Raises UserError if a part is missing or too large, differs from its record in dataset.json, or has an invalid row.
    """
    if not info.index:
        raise UserError(store.at(INFO_NAME), "index", "none", "the index of a finished dataset")
    pieces: list[pa.Table] = []
    last, n_rows = None, 0
    for part in info.index:
        for rows in _checked_groups(store, part):
            paths = rows["path"].combine_chunks()
            with_last = paths if last is None else pa.concat_arrays([pa.array([last], pa.string()), paths])
            if pc.any(pc.less_equal(with_last[1:], with_last[:-1])).as_py():
                raise UserError(store.at(part.path), "path", "repeated or unsorted paths", "each path once, sorted")
            last = paths[-1].as_py() if len(paths) else last
            pieces.append(rows)
            n_rows += len(rows)
            if n_rows > MAX_TOTAL_ROWS:
                raise UserError(store.at(FOLDER), "rows", f"more than {MAX_TOTAL_ROWS}", f"at most {MAX_TOTAL_ROWS}")
    return pa.concat_tables([INDEX.empty_table(), *pieces])


def _checked_groups(store: Store, recorded: IndexPart) -> Iterable[pa.Table]:
    """Yield the row groups of a part of the index."""
    where = store.at(recorded.path)
    n_bytes = store.plain_size(recorded.path)
    if n_bytes != recorded.bytes:
        raise UserError(where, "bytes", n_bytes, f"{recorded.bytes}, as in {INFO_NAME}")
    if store.sha256(recorded.path) != recorded.sha256 or recorded.path != f"{FOLDER}/{recorded.sha256[:16]}.parquet":
        raise UserError(where, "SHA-256", "a different SHA-256", f"SHA-256 {recorded.sha256}, as in {INFO_NAME}")
    part = Part(store, recorded.path, FOLDER, INDEX)
    stated = part.stated_groups()
    for group in range(part.n_groups):
        # Check the paths of each small group before decompressing the next one.
        n_group_rows = part.file.metadata.row_group(group).num_rows
        if part.n_rows > MAX_ROWS or n_group_rows > _ROWS_PER_GROUP:
            expected = f"at most {MAX_ROWS}, at most {_ROWS_PER_GROUP} in a row group"
            raise UserError(where, "rows", f"{part.n_rows}, {n_group_rows} in a row group", expected)
        rows = part.read(groups=[group])
        _check_rows(where, rows)
        for error in false_statistics(part, next(stated, {}), rows):
            raise error
        yield rows


def _check_rows(where: str, rows: pa.Table) -> None:
    """Raise UserError on the first invalid row."""
    paths = rows["path"]
    plain = pc.and_(pc.match_substring_regex(paths, _PATH), pc.less_equal(pc.binary_length(paths), _LONGEST_PATH))
    sizes = pc.and_(pc.greater_equal(rows["bytes"], 0), pc.less_equal(rows["bytes"], LARGEST_FILE_BYTES))
    checks = {
        "path": (plain, "a relative POSIX path of plain names inside the dataset"),
        "bytes": (sizes, f"0 to {LARGEST_FILE_BYTES}"),
        "sha256": (pc.match_substring_regex(rows["sha256"], _SHA256), "64 hexadecimal digits"),
    }
    for name, (fits, expected) in checks.items():
        wrong = rows[name].filter(pc.invert(pc.fill_null(fits, False)))
        if len(wrong):
            raise UserError(where, name, repr(wrong[0].as_py()), expected)
