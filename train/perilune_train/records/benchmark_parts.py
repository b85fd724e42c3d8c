"""The datasets of the locked benchmark, checked against the manifests that the repository provides.

The locked benchmark is a test set for final figures (docs/how-to/benchmark.md). Its manifests are in data_manifests/.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address, open_store

REGIONS = {
    "highland": "highland",
    "mare": "mare",
    "camera": "other camera",
    "npb": "elevation model",
    "npc": "elevation model",
    "oblique": "oblique",
}
"""Group in which the results of each dataset are listed, by the last word of the dataset's name. npb and npc are the
elevation models NPB_1km.tif and NPC_2km.tif."""
APART = "oblique"
"""Region that was added after results had been published: its results are listed apart, and the overall figures exclude
it, so that they stay comparable. It has no dataset of navigation."""
_POSE = ("position_m", "rotation_wxyz", "sun_direction")


@dataclass(frozen=True)
class Part:
    """One rendered dataset of the benchmark."""

    name: str
    """Name of the dataset and of its manifest: benchmark-<detect or nav>-<key of `REGIONS`>."""
    dataset: Dataset
    """The rendered frames."""
    n_locked: int
    """Number of frames in the manifest; the dataset may have fewer."""

    @property
    def region(self) -> str:
        """highland, mare, other camera, elevation model or oblique."""
        return REGIONS[self.name.rpartition("-")[2]]

    @property
    def is_apart(self) -> bool:
        """Whether the overall figures exclude this dataset."""
        return self.region == APART


def part_names(kind: str) -> list[str]:
    """Names of the datasets of a kind, `detect` or `nav`."""
    return [f"benchmark-{kind}-{part}" for part in REGIONS if kind == "detect" or part != APART]


def open_parts(kind: str, data: Address, manifests: Address) -> list[Part]:
    """Open the benchmark's datasets of a kind in the folder `data`, and compare them with their manifests.

    Datasets that were not rendered are left out. Raises UserError if there is no dataset that the overall figures
    include, if a dataset is not finished, or if a scene or a frame differs from the manifest.
    """
    store, locked = open_store(data), open_store(manifests)
    parts = []
    for name in part_names(kind):
        if store.exists(f"{name}/dataset.json"):
            dataset, manifest = open_single(store.sub(name)), open_single(locked.sub(name))
            if not dataset.info.complete:
                raise UserError(dataset.store, "complete", "false", "a finished dataset; resume its rendering")
            _check_scenes(dataset, manifest)
            _check_frames(dataset, manifest)
            parts.append(Part(name, dataset, manifest.info.counts.frames))
    if all(part.is_apart for part in parts):
        names = [name for name in part_names(kind) if not name.endswith(f"-{APART}")]
        found = f"only benchmark-{kind}-{APART}" if parts else "no dataset"
        raise UserError(store, "benchmark", found, f"one of {', '.join(names)}; see docs/how-to/benchmark.md")
    return parts


def _check_scenes(dataset: Dataset, manifest: Dataset) -> None:
    columns = ["scene_id", "content_sha256", "sun_azimuth_deg", "sun_elevation_deg", "photometry"]
    locked = {row["scene_id"]: row for row in manifest.table("scenes", columns).to_pylist()}
    for row in dataset.table("scenes", columns).to_pylist():
        expected = locked.get(row["scene_id"], {})
        for column in columns:
            if row[column] != expected.get(column):
                expected_text = f"{expected.get(column, 'no such scene')}, as in {manifest.store}"
                raise UserError(dataset.store, f"{row['scene_id']}: {column}", row[column], expected_text)


def _check_frames(dataset: Dataset, manifest: Dataset) -> None:
    columns = ["frame_id", "split", *_POSE]
    locked = manifest.table("frames", columns).to_pandas().set_index("frame_id")
    frames = dataset.table("frames", columns).to_pandas().set_index("frame_id")
    unknown = frames.index.difference(locked.index)
    if len(unknown):
        raise UserError(dataset.store, "frame_id", unknown[0], f"a frame of {manifest.store}")
    expected = locked.loc[frames.index]
    for column in _POSE:
        equal = np.isclose(_array(frames[column]), _array(expected[column]), rtol=0, atol=1e-9).all(axis=1)
        if not equal.all():
            raise UserError(
                dataset.store, column, f"another value in {frames.index[int(equal.argmin())]}", "the manifest's value"
            )
    if not (frames["split"] == "test").all():
        raise UserError(dataset.store, "split", "train or val", "test frames only")


def _array(column: pd.Series) -> np.ndarray:
    return np.stack([np.asarray(value, np.float64) for value in column])
