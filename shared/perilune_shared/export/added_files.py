"""Add files to a complete dataset (a card, metadata for search engines) and update its checksums."""

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.progress import NO_PROGRESS, Progress
from perilune_shared.storage import checksums, files
from perilune_shared.storage.locks import locked
from perilune_shared.validation.expected_files import EXTRA_NAMES


def check_sums(dataset: Dataset, paths: Iterable[Path], progress: Progress = NO_PROGRESS) -> dict[str, str] | None:
    """Check that `paths` may be written; return the hashes for a new SHA256SUMS, or None if it stays the same.

    The hashes are those of all other files of the dataset. SHA256SUMS changes if one of `paths` is directly in the
    folder of a complete dataset; an incomplete dataset has none yet. Raises UserError if the hash of another file is
    wrong, since new sums would hide it, or if a name is not allowed in a dataset
    (perilune_shared.validation.expected_files).
    """
    root = dataset.store.folder
    if root is None:
        return None
    for path in paths:
        if any(path.resolve().is_relative_to((root / folder).resolve()) for folder in ("manifest", "images")):
            raise UserError(path, "--out", "a file in manifest/ or images/", "a path outside these folders")
    own = {path.name for path in paths if path.resolve().parent == root.resolve()}
    for name in sorted(own - EXTRA_NAMES):
        raise UserError(dataset.store.at(name), "--out", name, f"{', '.join(sorted(EXTRA_NAMES))}, or another folder")
    if not own or not dataset.info.complete:
        return None
    for name, found, expected in checksums.faults_of(dataset.store, progress):
        if name not in own:
            raise UserError(dataset.store.at(name), "SHA-256", found, f"{expected}; see `perilune-manifest validate`")
    return {name: sha256 for name, sha256 in checksums.sums_of(dataset.store).items() if name not in own}


def default_path(dataset: Dataset, name: str) -> Path:
    """Return the path of a file directly in a local dataset. Raises UserError if the dataset is not local."""
    if dataset.store.folder is None:
        raise UserError(dataset.store, "--out", "none", "a local file, since the dataset is in an object store")
    return dataset.store.folder / name


def add_files(dataset: Dataset, contents: Mapping[Path, bytes], known: Mapping[str, str] | None) -> None:
    """Write files atomically, then SHA256SUMS unless `known`, the result of `check_sums`, is None."""
    root = dataset.store.folder
    with locked(root) if root is not None and known is not None else contextlib.nullcontext():
        for path, content in contents.items():
            files.write_bytes(path, content)
        if known is not None:
            checksums.seal(dataset.store, known=known)
