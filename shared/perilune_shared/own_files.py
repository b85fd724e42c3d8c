"""Files that are added to a finished dataset: a card, metadata for search engines. Its checksums stay right."""

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from perilune_shared import checksums, files
from perilune_shared.errors import UserError
from perilune_shared.locks import locked
from perilune_shared.manifest import Dataset


def check_sums(dataset: Dataset, paths: Iterable[Path]) -> bool:
    """Whether SHA256SUMS must be written anew once files are: where one lies in the folder of a complete dataset.

    The sums of all other files must be right before, since nobody would notice a fault after: UserError where one is
    not. A dataset that is not complete is sealed by whoever completes it.
    """
    for path in paths:
        if any(path.resolve().is_relative_to((dataset.root / folder).resolve()) for folder in ("manifest", "images")):
            raise UserError(path, "--out", "a file among the dataset's tables", "another place")
    own = {path.name for path in paths if path.resolve().parent == dataset.root.resolve()}
    if not own or not dataset.info.complete:
        return False
    for name, found, wanted in checksums.faults_of(dataset.root):
        if name not in own:
            raise UserError(dataset.root / name, "SHA-256", found, f"{wanted}; see `perilune-manifest validate`")
    return True


def add_files(dataset: Dataset, contents: Mapping[Path, bytes], *, seal: bool) -> None:
    """Write files, each whole or not at all, and then SHA256SUMS where `check_sums` said so."""
    with locked(dataset.root) if seal else contextlib.nullcontext():
        for path, content in contents.items():
            files.write_bytes(path, content)
        if seal:
            checksums.seal(dataset.root)
