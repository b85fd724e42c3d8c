"""Files that are added to a finished dataset: a card, metadata for search engines. Its checksums stay right."""

from collections.abc import Mapping
from pathlib import Path

from perilune_shared import checksums, files
from perilune_shared.errors import UserError
from perilune_shared.manifest import Dataset


def add_files(dataset: Dataset, contents: Mapping[Path, bytes]) -> None:
    """Write files; where one lies in the dataset's own folder, SHA256SUMS is written anew.

    The sums of all other files must be right before, since nobody would notice a fault after: UserError where one is
    not. A dataset that is not complete is sealed by whoever completes it.
    """
    root = dataset.root.resolve()
    own = {path.name for path in contents if path.resolve().parent == root}
    sealed = bool(own) and dataset.info.complete
    if sealed:
        for name, found, wanted in checksums.faults_of(dataset.root):
            if name not in own:
                where = dataset.root / name
                raise UserError(where, "SHA-256", found, f"{wanted}; see `perilune-manifest validate`")
    for path, content in contents.items():
        files.write_bytes(path, content)
    if sealed:
        checksums.seal(dataset.root)
