"""Compare the files of a dataset with the index, and find files that do not belong to the dataset.

Other tools may read files that this package ignores: any file below manifest/, and any Parquet file or image in the
folder. Therefore every unknown file is a fault. A file that does not belong to the dataset format is a fault even if
the index lists it.
"""

import functools
from collections.abc import Container, Iterator, Sequence
from pathlib import PurePosixPath

import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.dataset import index
from perilune_shared.dataset.index import INDEX, read_index
from perilune_shared.dataset.info_file import INFO_NAME, has_own_hash, read_info
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.names import IMAGE_KINDS, SCENE_FILE_KINDS, SUFFIXES, ImageKind, SceneFileKind
from perilune_shared.dataset.schema import TABLES
from perilune_shared.errors import UserError
from perilune_shared.storage.locks import LOCK_NAME, TEMPORARY_FILE
from perilune_shared.validation.faults import MAX_PER_COLUMN, Fault, FaultList, more_faults

EXTRA_NAMES = frozenset(
    {
        "README.md",
        "card.png",
        "overview.png",
        "croissant.json",
        "LICENSE",
        "LICENSE.md",
        "LICENSE.txt",
        "CITATION.cff",
    }
)
"""Files that tools or users may add directly in the dataset; `perilune-manifest card` adds them to the index."""
_RECORDS = "work"
"""Folder for the records of a rendering in progress."""
_LOCKS = (LOCK_NAME, f"{LOCK_NAME}.json")
_READ_FOLDERS = ("manifest/", "shards/")
"""Folders in which readers read all files, although no row of a table names them."""
_ROWS_AT_A_TIME = 10_000
_IN_INDEX = "as in the index"
_HASH = "SHA-256"


def check_files(dataset: Dataset, progress: Progress = NO_PROGRESS, replaced: Container[str] = ()) -> None:
    """Raise UserError about the first fault of the files, since writing a new index would hide it.

    Faults of frames are ignored, and faults of files that will be `replaced` or that no program reads.
    """
    for fault in file_faults(dataset, progress):
        unread = fault.column == "file" and not fault.file.startswith(_READ_FOLDERS)
        is_of_frames = fault.file == index.FOLDER
        if not unread and not is_of_frames and fault.file not in replaced:
            expected = f"{fault.expected}; see `perilune-manifest validate`"
            raise UserError(dataset.store.at(fault.file), fault.column, fault.found, expected)


def file_faults(dataset: Dataset, progress: Progress = NO_PROGRESS) -> Iterator[Fault]:
    """Yield the faults of dataset.json, of the index and of all files. The content of frames is not read.

    A writer's lock file is not a fault. An incomplete dataset has no index, so hashes are not checked; temporary files
    and the records of its rendering are not faults either.
    """
    try:
        frames = _named_files(dataset, "frames", IMAGE_KINDS)
    except UserError as error:
        yield Fault.from_error("manifest/frames", None, error)
        frames = None
    try:
        of_scenes = _named_files(dataset, "scenes", SCENE_FILE_KINDS)
    except UserError as error:
        yield Fault.from_error("manifest/scenes", None, error)
        of_scenes = INDEX.empty_table()
    if not dataset.info.complete:
        known = {*_named_by_format(dataset), *of_scenes["path"].to_pylist()}
        known |= set(frames["path"].to_pylist()) if frames is not None else set()
        _, strays = _listed(dataset, dataset.info, known)
        yield from strays
        return
    if not has_own_hash(dataset.store):
        expected = "the SHA-256 that is its last member, of the text before it"
        yield Fault.of(INFO_NAME, None, _HASH, "a different SHA-256", expected)
    try:
        # Read dataset.json again: a card may have been added since the dataset was opened.
        info = read_info(dataset.store)
        rows = read_index(dataset.store, info)
    except UserError as error:
        yield Fault.from_error(error.where.removeprefix(f"{dataset.store.address}/"), None, error)
        return
    sizes, strays = _listed(dataset, info, set(rows["path"].to_pylist()))
    yield from strays
    yield from _differences(rows, of_scenes, "scenes")
    if frames is not None:
        yield from _differences(rows, frames, "frames")
        rows = rows.filter(pc.invert(pc.is_in(rows["path"], frames["path"].combine_chunks())))
        by_format = pa.array({*_named_by_format(dataset), *of_scenes["path"].to_pylist()}, pa.string())
        odd = rows["path"].filter(pc.invert(pc.is_in(rows["path"], by_format)))
        for path in odd[:MAX_PER_COLUMN].to_pylist():
            yield Fault.of(path, None, "file", "an unexpected file", "only files of the dataset format")
        if len(odd) > MAX_PER_COLUMN:
            yield more_faults("file", len(odd) - MAX_PER_COLUMN)
    yield from _hash_faults(dataset, rows, sizes, progress)


def _named_files(dataset: Dataset, table: str, kinds: Sequence[ImageKind | SceneFileKind]) -> pa.Table:
    """Return path, bytes and sha256 of the files that the table `frames` or `scenes` names."""
    pieces = [pa.schema([field.with_nullable(True) for field in INDEX]).empty_table()]
    if dataset.info.images == "files":
        columns = [f"{kind}_{name}" for kind in kinds for name in ("path", "bytes", "sha256")]
        rows = dataset.table(table, columns)
        for kind in kinds:
            of_kind = rows.select([name for name in columns if name.startswith(kind)]).rename_columns(INDEX.names)
            # Keep only files of the expected type, so that other files remain faults even if a row names them.
            fits = pc.and_(
                pc.ends_with(of_kind["path"], SUFFIXES[kind]),
                pc.invert(pc.match_substring_regex(of_kind["path"], "^(manifest|shards|index)/")),
            )
            pieces.append(of_kind.filter(pc.fill_null(fits, False)))
    return pa.concat_tables([piece.replace_schema_metadata() for piece in pieces], promote_options="permissive")


def _named_by_format(dataset: Dataset) -> set[str]:
    """Return the paths of all files that the dataset may have, except files of frames and scenes."""
    parts = {path for table in TABLES for path in dataset.parts(table)}
    shards = set(dataset.shards()) if dataset.info.images == "packed" else set()
    return parts | shards | EXTRA_NAMES


def _listed(dataset: Dataset, info: DatasetInfo, known: set[str]) -> tuple[dict[str, int], list[Fault]]:
    """Return the sizes of known files, bytes, and a fault for each unknown file or folder.

    Memory does not grow with the number of unknown files.
    """
    fixed = {INFO_NAME, *_LOCKS, *(part.path for part in info.index)}
    folders = {path.rpartition("/")[0] for paths in (known, fixed) for path in paths}
    folders |= {index.FOLDER, *(f"manifest/{table}" for table in TABLES)}
    folders |= {str(parent) for folder in folders for parent in PurePosixPath(folder).parents}
    sizes: dict[str, int] = {}
    # The number of listed faults is limited. Use two lists, so that many unknown files elsewhere cannot displace
    # unknown files in folders that are read.
    in_read_folders, elsewhere = FaultList(), FaultList()
    last = ""
    for item in dataset.store.list():
        path = item.path
        if path in known:
            sizes[path] = item.size_bytes
        elif path not in fixed and not (not info.complete and _is_of_rendering(path)):
            folder = path.rpartition("/")[0]
            unknown = path if folder in folders else _top_unknown(folder, folders)
            # The files of one folder follow each other in the listing.
            if unknown != last:
                strays = in_read_folders if unknown.startswith(_READ_FOLDERS) else elsewhere
                strays.add_made("file", functools.partial(_stray, unknown))
            last = unknown
    return sizes, [*in_read_folders.faults(), *elsewhere.faults()]


def _stray(path: str) -> Fault:
    return Fault.of(path, None, "file", "a file or folder that is not in the index", _cure(path))


def _is_of_rendering(path: str) -> bool:
    """Whether a file belongs to a rendering in progress."""
    return path.split("/")[0] == _RECORDS or bool(TEMPORARY_FILE.fullmatch(PurePosixPath(path).name))


def _top_unknown(folder: str, folders: set[str]) -> str:
    """Return the topmost folder of the path `folder` that is not in `folders`."""
    above = [*reversed(PurePosixPath(folder).parents)][1:]
    return next((str(parent) for parent in above if str(parent) not in folders), folder)


def _cure(path: str) -> str:
    """Return advice on an unknown file."""
    name = PurePosixPath(path).name
    if path in EXTRA_NAMES:
        return "a file in the index; `perilune-manifest card` on the dataset adds it, or delete it"
    if path.startswith(f"{index.FOLDER}/") or TEMPORARY_FILE.fullmatch(name):
        return (
            "no such file: a stopped command left it; `perilune-manifest card` on the dataset removes it, or delete it"
        )
    return "only files of the dataset format (docs/reference/validation.md)"


def _differences(rows: pa.Table, named: pa.Table, table: str) -> Iterator[Fault]:
    """Compare the index with the files that the table `frames` or `scenes` names.

    Yields the first difference in path, in size and in hash. These faults name the index folder as their file.
    """
    rows_in_index = pc.index_in(named["path"], rows["path"].combine_chunks())
    if rows_in_index.null_count:
        missing = named["path"].filter(pc.is_null(rows_in_index))[0].as_py()
        expected = f"every {table.removesuffix('s')} of the table {table}"
        yield Fault.of(index.FOLDER, None, "path", f"no {missing}", expected)
    named, rows_in_index = named.filter(pc.is_valid(rows_in_index)), rows_in_index.drop_null()
    for name in ("bytes", "sha256"):
        recorded = rows[name].take(rows_in_index)
        equal = pc.fill_null(pc.equal(recorded, named[name]), False)
        row = pc.index(equal, False).as_py()
        if row >= 0:
            path, expected = named["path"][row].as_py(), named[name][row].as_py()
            yield Fault.of(
                index.FOLDER, None, name, f"{recorded[row].as_py()} for {path}", f"{expected}, as in {table}"
            )


def _hash_faults(dataset: Dataset, rows: pa.Table, sizes: dict[str, int], progress: Progress) -> Iterator[Fault]:
    """Compare size and hash of files with the index."""
    store, total = dataset.store, (pc.sum(rows["bytes"]).as_py() or 0) / 1e6
    task = progress.add_task("hashing", total=total, unit="MB")
    n_missing = 0
    for path, n_bytes, sha256 in _rows_of(rows):
        if path not in sizes:
            n_missing += 1
            if n_missing > MAX_PER_COLUMN:
                continue
            yield Fault.of(path, None, _HASH, "no such file", f"the file with SHA-256 {sha256}, {_IN_INDEX}")
            continue
        try:
            if store.is_local:
                store.plain_size(path)
            if sizes[path] != n_bytes:
                yield Fault.of(path, None, _HASH, f"{sizes[path]} bytes", f"{n_bytes} bytes, {_IN_INDEX}")
            elif store.sha256(path, lambda n: progress.advance(task, n / 1e6)) != sha256:
                yield Fault.of(path, None, _HASH, "a different SHA-256", f"SHA-256 {sha256}, {_IN_INDEX}")
        except UserError as error:
            yield Fault.of(path, None, _HASH, error.found, error.expected)
    if n_missing > MAX_PER_COLUMN:
        yield more_faults(_HASH, n_missing - MAX_PER_COLUMN)
    progress.update(task, completed=total)


def _rows_of(rows: pa.Table) -> Iterator[tuple[str, int, str]]:
    """Yield path, size and hash of each row; convert few rows at a time, to limit memory."""
    for batch in rows.to_batches(max_chunksize=_ROWS_AT_A_TIME):
        yield from zip(*(batch[name].to_pylist() for name in INDEX.names), strict=True)
