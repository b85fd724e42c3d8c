"""Add files to a complete dataset (a card, metadata for search engines) and to its index."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.dataset.index import index_rows, read_index, seal
from perilune_shared.dataset.info_file import INFO_NAME, read_info
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.parts import Written
from perilune_shared.errors import UserError
from perilune_shared.progress import NO_PROGRESS, Progress
from perilune_shared.storage import files
from perilune_shared.storage.locks import locked
from perilune_shared.validation.files import EXTRA_NAMES, check_files

_LARGEST_BYTES = 2**26


def check_index(dataset: Dataset, paths: Iterable[Path], progress: Progress = NO_PROGRESS) -> DatasetInfo | None:
    """Check that `paths` may be written; return dataset.json, or None if index and dataset.json stay the same.

    The index changes if one of `paths` is directly in the folder of a complete dataset; an incomplete dataset has none
    yet. Raises UserError if another file differs from the index, since a new index would hide it, or if a name is not
    allowed in a dataset (perilune_shared.validation.files).
    """
    root = dataset.store.folder
    if root is None:
        return None
    for path in paths:
        if any(path.resolve().is_relative_to((root / folder).resolve()) for folder in ("manifest", "images")):
            raise UserError(path, "--out", "a file in manifest/ or images/", "a path outside these folders")
    own = _names_in(dataset, paths)
    for name in sorted(own - EXTRA_NAMES):
        raise UserError(dataset.store.at(name), "--out", name, f"{', '.join(sorted(EXTRA_NAMES))}, or another folder")
    if not own or not dataset.info.complete:
        return None
    info = read_info(dataset.store)
    check_files(dataset, progress, replaced=own)
    return info


def default_path(dataset: Dataset, name: str) -> Path:
    """Return the path of a file directly in a local dataset. Raises UserError if the dataset is not local."""
    if dataset.store.folder is None:
        raise UserError(dataset.store, "--out", "none", "a local file, since the dataset is in an object store")
    return dataset.store.folder / name


def add_files(dataset: Dataset, contents: Mapping[Path, bytes], info: DatasetInfo | None) -> None:
    """Write files atomically, and the index unless `info`, the result of `check_index`, is None.

    If the process is killed, `validate` finds the old dataset, the new one, or files that are not in the index; the
    next call adds or removes these. Raises UserError if the dataset changed since it was checked.
    """
    root, store = dataset.store.folder, dataset.store
    if info is None or root is None:
        for path, content in contents.items():
            files.write_bytes(path, content)
        return
    with locked(root):
        if read_info(store) != info:
            raise UserError(store.at(INFO_NAME), "content", "changed meanwhile", "no other writer; run it again")
        own = _names_in(dataset, contents)
        rows = read_index(store, info)
        others = rows.filter(pc.invert(pc.is_in(rows["path"], pa.array(sorted(own), pa.string()))))
        # No file that an index names is overwritten: take the old ones out first.
        info = info if len(others) == len(rows) else seal(store, info, others)
        for path, content in contents.items():
            if path.name in own:
                store.replace(path.name, content)
            else:
                files.write_bytes(path, content)
        known = {*others["path"].to_pylist(), *own}
        extra = sorted(name for name in EXTRA_NAMES - known if store.exists(name))
        added = {path.name: content for path, content in contents.items() if path.name in own}
        added |= {name: store.read(name, most_bytes=_LARGEST_BYTES) for name in extra}
        written = index_rows(Written.of(name, content) for name, content in added.items())
        seal(store, info, pa.concat_tables([others, written]))


def _names_in(dataset: Dataset, paths: Iterable[Path]) -> set[str]:
    """Return the names of the paths that are directly in the folder of a local dataset."""
    root = dataset.store.folder
    return {path.name for path in paths if root is not None and path.resolve().parent == root.resolve()}
