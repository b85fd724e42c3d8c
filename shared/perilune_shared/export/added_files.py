"""Add files to a complete dataset (a card, metadata for search engines) and to its index."""

import contextlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.dataset.index import index_rows, read_index, seal
from perilune_shared.dataset.info_file import INFO_NAME, read_info
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.parts import WrittenFile
from perilune_shared.errors import UserError
from perilune_shared.storage import files
from perilune_shared.storage.locks import locked
from perilune_shared.storage.store import Store, open_store
from perilune_shared.validation.files import EXTRA_NAMES, check_files

_LARGEST_BYTES = 2**26


@dataclass(frozen=True, slots=True)
class Target:
    """A file to write, either directly in a dataset or elsewhere."""

    store: Store
    """Folder or prefix that directly contains the file; the dataset's store if the file is in the dataset."""
    name: str
    """File name."""

    @classmethod
    def of(cls, dataset: Dataset, out: str | os.PathLike[str] | None, name: str) -> "Target":
        """Return the target at the path or address `out`, or the file `name` in the dataset if `out` is None."""
        if out is None:
            return cls(dataset.store, name)
        prefix, _, last = os.fspath(out).rpartition("/")
        store = open_store(prefix) if "://" in os.fspath(out) else open_store(Path(out).parent)
        return cls(dataset.store if _is_same(store, dataset.store) else store, last or Path(out).name)

    @property
    def address(self) -> str:
        """Path or address of the file."""
        return self.store.at(self.name) if self.store.folder is None else str(self.store.folder / self.name)

    def sibling(self, name: str) -> "Target":
        """Return another file in the same folder."""
        return Target(self.store, name)

    def content(self) -> bytes | None:
        """Return the current content; None if there is no file.

        Raises UserError on a large or non-regular file.
        """
        if self.store.folder is not None and not (self.store.folder / self.name).exists():
            return None
        if self.store.folder is None and not self.store.exists(self.name):
            return None
        return self.store.read(self.name, most_bytes=_LARGEST_BYTES)

    def write(self, content: bytes) -> None:
        """Write the file, or replace it."""
        if self.store.folder is None or files.is_plain(self.name):
            self.store.replace(self.name, content)
        else:  # outside of datasets, names may have blanks and other characters
            files.write_bytes(self.store.folder / self.name, content)


def check_index(dataset: Dataset, targets: Iterable[Target], progress: Progress = NO_PROGRESS) -> DatasetInfo | None:
    """Check that the files `targets` may be written; return dataset.json if the index will change.

    The index changes if one of the files is directly in a complete dataset. Returns None if the index does not change:
    if all files are elsewhere, or if the dataset is incomplete and has no index yet. Raises UserError if another file
    differs from the index, since a new index would hide the difference, or if a dataset may not contain a file of this
    name (perilune_shared.validation.files).
    """
    for target in targets:
        if _is_below(target.store, dataset.store):
            expected = "a file directly in the dataset, or outside of it"
            raise UserError(target.address, "--out", "a file in a folder of the dataset", expected)
    names_in_dataset = _names_in_dataset(dataset, targets)
    for name in sorted(names_in_dataset - EXTRA_NAMES):
        raise UserError(dataset.store.at(name), "--out", name, f"{', '.join(sorted(EXTRA_NAMES))}, or another folder")
    if not names_in_dataset or not dataset.info.complete:
        return None
    info = read_info(dataset.store)
    check_files(dataset, progress, replaced=names_in_dataset)
    return info


def add_files(
    dataset: Dataset, contents: Mapping[Target, bytes], info: DatasetInfo | None, licence: str | None = None
) -> None:
    """Write files atomically, and add them to the index unless `info` is None.

    `info` is the result of `check_index`. If the index is written, `licence` replaces the licence of the dataset.

    If the process is killed, `validate` finds the old dataset, the new dataset, or files that are not in the index. The
    next call adds or removes these files. Simultaneous calls exclude each other only in a local folder. Raises
    UserError if the dataset changed since it was checked.
    """
    store = dataset.store
    if info is None:
        for target, content in contents.items():
            target.write(content)
        return
    with locked(store.folder) if store.folder is not None else contextlib.nullcontext():
        if read_info(store) != info:
            raise UserError(store.at(INFO_NAME), "content", "changed meanwhile", "no other writer; run it again")
        names_in_dataset = _names_in_dataset(dataset, contents)
        rows = read_index(store, info)
        others = rows.filter(pc.invert(pc.is_in(rows["path"], pa.array(sorted(names_in_dataset), pa.string()))))
        # Never overwrite a file that the index lists: remove the old files from the index first.
        info = info if len(others) == len(rows) else seal(store, info, others)
        for target, content in contents.items():
            target.write(content)
        known = {*others["path"].to_pylist(), *names_in_dataset}
        extra = sorted(name for name in EXTRA_NAMES - known if store.exists(name))
        added = {target.name: content for target, content in contents.items() if target.name in names_in_dataset}
        added |= {name: store.read(name, most_bytes=_LARGEST_BYTES) for name in extra}
        written = index_rows(WrittenFile.of(name, content) for name, content in added.items())
        info = info if licence is None else info.model_copy(update={"licence": licence})
        seal(store, info, pa.concat_tables([others, written]))


def _names_in_dataset(dataset: Dataset, targets: Iterable[Target]) -> set[str]:
    """Return the names of the files that are directly in the dataset."""
    return {target.name for target in targets if target.store is dataset.store}


def _is_same(store: Store, other: Store) -> bool:
    if store.folder is None or other.folder is None:
        return store == other
    return store.folder.resolve() == other.folder.resolve()


def _is_below(store: Store, other: Store) -> bool:
    """Whether `store` is a folder or prefix below `other`."""
    if _is_same(store, other):
        return False
    if store.folder is None or other.folder is None:
        return store.address.startswith(f"{other.address}/")
    return store.folder.resolve().is_relative_to(other.folder.resolve())
