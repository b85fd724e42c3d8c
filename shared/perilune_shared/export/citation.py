"""The citation of a dataset, with a hash of its tables."""

import hashlib

import pyarrow.compute as pc

from perilune_shared.dataset.index import read_index
from perilune_shared.dataset.info_file import read_info
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.schema import TABLES


def citation_of(dataset: Dataset) -> str:
    """Return a BibTeX entry that identifies this dataset by the hash of its tables.

    The tables contain the hashes of the frames. Cards and other added files do not change the hash. To print the hash
    in a shell: `sha256sum manifest/*/*.parquet | sha256sum`.
    """
    lines = "".join(f"{sha256}  {path}\n" for path, sha256 in sorted(table_hashes(dataset).items()))
    sha256 = hashlib.sha256(lines.encode()).hexdigest()
    key = "".join(c if c.isascii() and c.isalnum() else "-" for c in dataset.info.name).strip("-")
    note = "Rendered images of lunar landing trajectories. "
    note += f"SHA-256 of the output of `sha256sum manifest/*/*.parquet`: {sha256}"
    return f"@misc{{{key}, title = {{{dataset.info.name}}}, howpublished = {{perilune dataset}}, note = {{{note}}}}}"


def table_hashes(dataset: Dataset) -> dict[str, str]:
    """Return the SHA-256 of each part of all tables, by path.

    The hashes come from the index. An incomplete dataset has no index, so its hashes are computed.
    """
    if not dataset.info.complete:
        return {path: dataset.store.sha256(path) for table in TABLES for path in dataset.parts(table)}
    rows = read_index(dataset.store, read_info(dataset.store))
    rows = rows.filter(pc.starts_with(rows["path"], "manifest/"))
    return dict(zip(rows["path"].to_pylist(), rows["sha256"].to_pylist(), strict=True))
