"""Which paths a dataset's folder may hold.

Other tools read files that this package does not: every file below manifest/ of any name, every Parquet file or
picture in the folder. So whatever is not expected is a fault, listed in SHA256SUMS or not.
"""

import os
from collections.abc import Iterator
from pathlib import Path

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import INFO_NAME
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
"""Files in the dataset's folder itself that tools or people may add; with dataset.json they are in SHA256SUMS."""
_LOCKS = (LOCK_NAME, f"{LOCK_NAME}.json")
_MOST = 1000


def unexpected(dataset: Dataset) -> Iterator[str]:
    """Paths relative to the dataset of files and folders that do not belong to it, at most 1000 of them.

    A folder with files comes alone, without what lies in it; an empty one is no fault. The lock of a writer is no part
    of the dataset; while a dataset is not complete, neither are the writer's temporary files.
    """
    own_folders = {"manifest", *(f"manifest/{table}" for table in TABLES)}
    own_files = {INFO_NAME, SUMS_NAME, *EXTRA_NAMES, *_LOCKS}
    own_files |= {path.relative_to(dataset.root).as_posix() for table in TABLES for path in dataset.parts(table)}
    if dataset.info.images == "packed":
        own_folders.add("images")
        own_files |= {path.relative_to(dataset.root).as_posix() for path in dataset.shards()}
    if dataset.info.images == "files":
        frames = dataset.table("frames", ["png_path", "exr_path"])
        for kind in ("png", "exr"):
            # A row must not make a table of any other file.
            paths = [path for path in frames[f"{kind}_path"].to_pylist() if path and path.endswith(f".{kind}")]
            own_files |= {path for path in paths if path.split("/")[0] not in ("manifest", "images")}
        own_folders |= {str(parent) for path in own_files for parent in Path(path).parents if str(parent) != "."}
    n_found = 0
    for root, folders, names in os.walk(dataset.root):
        place = Path(root).relative_to(dataset.root)
        inner = [(place / name).as_posix() for name in folders]
        folders[:] = [name for name, path in zip(folders, inner, strict=True) if path in own_folders]
        odd = [path for path in inner if path not in own_folders and _holds_files(dataset.root / path)]
        odd += [path for path in inner if path in own_folders and (dataset.root / path).is_symlink()]
        for name in names:
            path = (place / name).as_posix()
            if path not in own_files and (dataset.info.complete or not TEMPORARY_FILE.fullmatch(name)):
                odd.append(path)
        for path in sorted(odd):
            n_found += 1
            yield path
            if n_found == _MOST:
                return


def _holds_files(folder: Path) -> bool:
    """Whether a folder is a link or has a file at any depth."""
    return folder.is_symlink() or any(
        names or any(Path(root, name).is_symlink() for name in folders) for root, folders, names in os.walk(folder)
    )
