"""Re-split a dataset into train, val and test."""

import numpy as np
import pyarrow as pa

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import ImageMode, SplitUnit
from perilune_shared.editing.flights import terrains_and_flights
from perilune_shared.editing.rewrite import check_source, rewrite
from perilune_shared.editing.writer import SceneTables, with_column
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address


def split_dataset(
    source: Dataset,
    out: Address,
    by: SplitUnit = "scene",
    val_share: float = 0.1,
    test_share: float = 0.1,
    seed: int = 0,
    images: ImageMode = "copy",
    progress: Progress = NO_PROGRESS,
) -> None:
    """Write a dataset whose scenes, trajectories or frames are randomly assigned to train, val and test.

    Units are identified by content, not by name (`perilune_shared.editing.flights`). Scenes with the same terrain are
    one unit, even if their names or Suns differ; so are all scenes on one elevation model. Trajectories of one flight
    are one unit, also if the flight was rendered or developed again. Frames with one pose are one unit. `frame` with
    shares of 0.1 is the paper's protocol: all three splits contain the same terrain, so test metrics are optimistic;
    `split_by` in dataset.json records it. Each split with a share above 0 gets at least one unit. Raises UserError if
    there are too few units.
    """
    if not (0 <= val_share < 1 and 0 <= test_share < 1 and val_share + test_share < 1):
        raise UserError("--val and --test", "shares", f"{val_share}, {test_share}", "at least 0, with a sum below 1")
    check_source(source, out, progress)
    frames = terrains_and_flights(source)
    key = {"scene": "terrain", "trajectory": "flight", "frame": "pose"}[by]
    units = frames[key].drop_duplicates().to_numpy()
    n_val, n_test = (int(np.ceil(share * len(units))) for share in (val_share, test_share))
    if n_val + n_test >= len(units):
        expected = f"more than {n_val + n_test}, for train, val and test"
        raise UserError(source.store, "--by", f"{len(units)} {key}{'s' if len(units) > 1 else ''}", expected)
    names = np.array(["train"] * (len(units) - n_val - n_test) + ["val"] * n_val + ["test"] * n_test)
    assigned = dict(zip(units, np.random.default_rng(seed).permutation(names), strict=True))
    split_of = dict(zip(frames["frame_id"], frames[key].map(assigned), strict=True))

    def change(tables: SceneTables) -> SceneTables:
        ids = tables["frames"]["frame_id"].to_pylist()
        splits = pa.array([str(split_of[frame_id]) for frame_id in ids], pa.string())
        return {**tables, "frames": with_column(tables["frames"], "split", splits)}

    line = f"split by {by}, val {val_share:g}, test {test_share:g}, seed {seed}"
    rewrite(source, out, source.info.changed(line), change, images, progress)
