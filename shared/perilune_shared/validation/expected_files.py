"""Find files that do not belong in a dataset's folder.

Other tools may read files that this package ignores: any file below manifest/, any Parquet file or image in the folder.
So every unexpected file is a fault, even if it is listed in SHA256SUMS.
"""

from collections.abc import Iterator
from pathlib import PurePosixPath

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
    own_files |= {path for table in TABLES for path in dataset.parts(table)}
    if dataset.info.images == "packed":
        own_folders.add("shards")
        own_files |= set(dataset.shards())
    if dataset.info.images == "files":
        frames = dataset.table("frames", ["png_path", "exr_path"])
        for kind in ("png", "exr"):
            # Files of other types stay unexpected, even if a row of `frames` lists them.
            paths = [path for path in frames[f"{kind}_path"].to_pylist() if path and path.endswith(f".{kind}")]
            own_files |= {path for path in paths if path.split("/")[0] not in ("manifest", "shards")}
        own_folders |= {str(parent) for path in own_files for parent in PurePosixPath(path).parents} - {"."}
    reported: set[str] = set()
    for item in dataset.store.list():
        path = PurePosixPath(item.path)
        if item.path in own_files or (not dataset.info.complete and TEMPORARY_FILE.fullmatch(path.name)):
            continue
        if not dataset.info.complete and path.parts[0] == _RECORDS:
            continue
        folders = [str(folder) for folder in reversed(path.parents) if str(folder) != "."]
        found = next((folder for folder in folders if folder not in own_folders), item.path)
        if found not in reported:
            reported.add(found)
            yield found
            if len(reported) == _MAX_REPORTED:
                return
