"""Re-split a dataset into train, val and test."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.content import terrain_of
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import ImageMode, SplitUnit, trajectory_of_body
from perilune_shared.editing.rewrite import Rewriting, check_source, rewrite
from perilune_shared.editing.writer import SceneTables, with_column
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address


@dataclass(frozen=True, slots=True)
class Split:
    """How a dataset is split."""

    by: SplitUnit = "scene"
    """What is never divided between splits (the unit): scene, trajectory or frame."""
    val_share: float = 0.1
    """Share of the units in the validation split."""
    test_share: float = 0.1
    """Share of the units in the test split."""
    seed: int = 0
    """Random seed of the split."""


def split_dataset(
    source: Dataset,
    out: Address,
    split: Split | None = None,
    images: ImageMode = "copy",
    progress: Progress = NO_PROGRESS,
) -> None:
    """Write a dataset whose scenes, trajectories or frames are randomly assigned to train, val and test.

    By default scenes are assigned, with shares of 0.1 for val and test. Units are identified by content, not by name
    (`terrains_and_flights`):

    - Scenes with the same terrain are one unit, even if their names or Sun directions differ. All scenes on one
      elevation model are one unit.
    - Trajectories of one flight are one unit, even if the flight was rendered or developed several times.
    - Frames with equal poses over the same terrain are one unit.

    The paper's protocol is `frame` with shares of 0.1. All three splits then contain the same terrain, so test metrics
    are optimistic; `split_by` in dataset.json records the unit. Each split with a share above 0 gets at least one unit.
    Raises UserError if there are too few units.
    """
    split = split or Split()
    by, val_share, test_share, seed = split.by, split.val_share, split.test_share, split.seed
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
    rewrite(source, out, Rewriting(source.info.changed(line), change, images), progress)


def terrains_and_flights(dataset: Dataset) -> pd.DataFrame:
    """Return a table of all frames, sorted by frame_id, with the columns `terrain`, `flight` and `pose`.

    A split by one of these columns keeps rows with equal values together. `terrain` is the key from `terrain_of`.
    `pose` is a number for each distinct position and rotation over a terrain; all cameras at one instant have the same
    number. `flight` is a number for trajectories over one terrain that have equal random seeds or a common pose, for
    example because a flight was developed again or rendered with another Sun.
    """
    columns = ["frame_id", "scene_id", "trajectory_id", "position_m", "rotation_wxyz"]
    rows = dataset.table("frames", [*columns, "camera", "frame_index"]).sort_by("frame_id")
    frames = rows.select(columns[:3]).to_pandas()
    scenes = dataset.table("scenes", ["scene_id", "dem_source", "content_sha256"]).to_pandas()
    terrain = {row.scene_id: terrain_of(row.dem_source, row.content_sha256) for row in scenes.itertuples()}
    frames["terrain"] = frames["scene_id"].map(terrain)
    seeds = dataset.table("trajectories", ["scene_id", "trajectory_id", "seed"]).to_pandas()
    frames["seed"] = frames.merge(seeds, on=["scene_id", "trajectory_id"], how="left")["seed"].to_numpy()
    numbers = [
        rows[name].combine_chunks().flatten().to_numpy(zero_copy_only=False).reshape(len(rows), -1)
        for name in columns[3:5]
    ]
    # Adding 0.0 turns negative zero into zero.
    poses = pd.DataFrame(np.hstack(numbers) + 0.0).assign(terrain=frames["terrain"].to_numpy())
    frames["pose"] = poses.groupby(list(poses.columns), dropna=False).ngroup().to_numpy()
    if dataset.info.cameras is not None:
        rig = rows.select(["scene_id", "trajectory_id", "camera", "frame_index"]).to_pylist()
        names = [trajectory_of_body(str(row["camera"]), row["trajectory_id"]) for row in rig]
        instant = frames.assign(body=names, index=rows["frame_index"].to_numpy()).groupby(["scene_id", "body", "index"])
        frames["pose"] = _connected_groups(frames["pose"].to_numpy(), [instant.ngroup().to_numpy()])
    trajectory = frames.groupby(["scene_id", "trajectory_id"], sort=False).ngroup().to_numpy()
    by_seed = frames.groupby(["terrain", "seed"], dropna=False).ngroup().to_numpy()
    frames["flight"] = _connected_groups(trajectory, [by_seed, frames["pose"].to_numpy()])
    return frames[["frame_id", "terrain", "flight", "pose"]]


def _connected_groups(unit: NDArray[np.int64], keys: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Return the group number of each row (N,).

    Two rows are in one group if they have equal units or an equal value of any key, or if other rows connect them in
    this way. `unit` (N,) has numbers from 0; each array in `keys` has the shape (N,).
    """
    root = np.arange(unit.max(initial=-1) + 1)

    def find(number: int) -> int:
        while root[number] != number:
            root[number] = root[root[number]]
            number = root[number]
        return number

    for key in keys:
        pairs = pd.DataFrame({"key": key, "unit": unit}).drop_duplicates()
        first = pairs.groupby("key")["unit"].transform("first").to_numpy()
        second = pairs["unit"].to_numpy()
        for left, right in zip(first[first != second], second[first != second], strict=True):
            root[find(int(right))] = find(int(left))
    return np.array([find(number) for number in range(len(root))], np.int64)[unit]
