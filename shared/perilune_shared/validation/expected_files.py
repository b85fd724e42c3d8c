"""Find files that do not belong in a dataset's folder.

Other tools may read files that this package ignores: any file below manifest/, any Parquet file or image in the folder.
So every unexpected file is a fault, even if it is listed in SHA256SUMS.
"""

import os
from collections.abc import Iterator
from pathlib import Path

from perilune_shared.dataset.info_file import INFO_NAME
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.schema import TABLES
from perilune_shared.storage.checksums import SUMS_NAME
from perilune_shared.storage.locks import LOCK_NAME, TEMPORARY_FILE

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
"""Files that tools or users may add directly in the dataset's folder; like dataset.json they are in SHA256SUMS."""
_RECORDS = "work"
"""Folder of the records of a rendering in progress."""
_LOCKS = (LOCK_NAME, f"{LOCK_NAME}.json")
_MAX_REPORTED = 1000


def unexpected(dataset: Dataset) -> Iterator[str]:
    """Yield relative paths of files and folders that do not belong to the dataset, at most 1000.

    An unexpected folder is reported without its content, and only if it is not empty. The lock of a writer is accepted;
    its temporary files and records are accepted while the dataset is not complete.
    """
    own_folders = {"manifest", *(f"manifest/{table}" for table in TABLES)}
    own_files = {INFO_NAME, SUMS_NAME, *EXTRA_NAMES, *_LOCKS}
    own_files |= {path.relative_to(dataset.root).as_posix() for table in TABLES for path in dataset.parts(table)}
    if dataset.info.images == "packed":
        own_folders.add("shards")
        own_files |= {path.relative_to(dataset.root).as_posix() for path in dataset.shards()}
    if dataset.info.images == "files":
        frames = dataset.table("frames", ["png_path", "exr_path"])
        for kind in ("png", "exr"):
            # Files of other types stay unexpected, even if a row of `frames` lists them.
            paths = [path for path in frames[f"{kind}_path"].to_pylist() if path and path.endswith(f".{kind}")]
            own_files |= {path for path in paths if path.split("/")[0] not in ("manifest", "shards")}
        own_folders |= {str(parent) for path in own_files for parent in Path(path).parents if str(parent) != "."}
    n_found = 0
    for root, folders, names in os.walk(dataset.root):
        place = Path(root).relative_to(dataset.root)
        if not dataset.info.complete and root == str(dataset.root) and _RECORDS in folders:
            folders.remove(_RECORDS)
        inner = [(place / name).as_posix() for name in folders]
        folders[:] = [name for name, path in zip(folders, inner, strict=True) if path in own_folders]
        found = [path for path in inner if path not in own_folders and _contains_files(dataset.root / path)]
        found += [path for path in inner if path in own_folders and (dataset.root / path).is_symlink()]
        for name in names:
            path = (place / name).as_posix()
            if path not in own_files and (dataset.info.complete or not TEMPORARY_FILE.fullmatch(name)):
                found.append(path)
        for path in sorted(found):
            n_found += 1
            yield path
            if n_found == _MAX_REPORTED:
                return


def _contains_files(folder: Path) -> bool:
    """Whether a folder is a link, or contains a file or link at any depth."""
    return folder.is_symlink() or any(
        names or any(Path(root, name).is_symlink() for name in folders) for root, folders, names in os.walk(folder)
    )
