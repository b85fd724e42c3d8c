"""Files that are added to a finished dataset: a card, metadata for search engines. Its checksums stay right."""

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from rich.progress import Progress

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.storage import checksums, files
from perilune_shared.storage.locks import locked
from perilune_shared.validation.expected_files import EXTRA_NAMES


def check_sums(dataset: Dataset, paths: Iterable[Path], progress: Progress | None = None) -> dict[str, str] | None:
    """Hashes of the dataset's other files where SHA256SUMS must be rewritten once `paths` are written, else None.

    That is where one of them lies in the folder of a complete dataset. SHA256SUMS of an incomplete dataset is written
    when it is completed. Raises UserError where the hash of another file is wrong, since new sums would hide it, or a
    name is not one that a dataset may have (perilune_shared.validation.expected_files).
    """
    for path in paths:
        if any(path.resolve().is_relative_to((dataset.root / folder).resolve()) for folder in ("manifest", "images")):
            raise UserError(path, "--out", "a file among the dataset's tables", "another place")
    own = {path.name for path in paths if path.resolve().parent == dataset.root.resolve()}
    for name in sorted(own - EXTRA_NAMES):
        raise UserError(dataset.root / name, "--out", name, f"{', '.join(sorted(EXTRA_NAMES))}, or another folder")
    if not own or not dataset.info.complete:
        return None
    for name, found, wanted in checksums.faults_of(dataset.root, progress):
        if name not in own:
            raise UserError(dataset.root / name, "SHA-256", found, f"{wanted}; see `perilune-manifest validate`")
    return {name: sha256 for name, sha256 in checksums.sums_of(dataset.root).items() if name not in own}


def add_files(dataset: Dataset, contents: Mapping[Path, bytes], known: Mapping[str, str] | None) -> None:
    """Write files, each whole or not at all, and then SHA256SUMS where `check_sums` gave the hashes of the others."""
    with locked(dataset.root) if known is not None else contextlib.nullcontext():
        for path, content in contents.items():
            files.write_bytes(path, content)
        if known is not None:
            checksums.seal(dataset.root, known=known)
