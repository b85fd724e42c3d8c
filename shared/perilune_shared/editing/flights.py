"""Find trajectories of the same flight: the same terrain seen from the same poses, independent of names."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.content import terrain_of
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import trajectory_of_body


def terrains_and_flights(dataset: Dataset) -> pd.DataFrame:
    """Return the table of all frames, sorted by frame_id, with their `terrain`, `flight` and `pose`.

    Terrain is the key from `terrain_of`; pose numbers each position and rotation over a terrain. Trajectories over one
    terrain are the same flight if they have the same random seed or a common pose. So a flight that was developed again
    or rendered with another Sun is the same flight. A split by one of these units puts each unit in one split.
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
    if dataset.info.cameras is not None:  # the poses of all cameras of one instant are one unit
        rig = rows.select(["scene_id", "trajectory_id", "camera", "frame_index"]).to_pylist()
        names = [trajectory_of_body(str(row["camera"]), row["trajectory_id"]) for row in rig]
        instant = frames.assign(body=names, index=rows["frame_index"].to_numpy()).groupby(["scene_id", "body", "index"])
        frames["pose"] = _connected_groups(frames["pose"].to_numpy(), [instant.ngroup().to_numpy()])
    trajectory = frames.groupby(["scene_id", "trajectory_id"], sort=False).ngroup().to_numpy()
    by_seed = frames.groupby(["terrain", "seed"], dropna=False).ngroup().to_numpy()
    frames["flight"] = _connected_groups(trajectory, [by_seed, frames["pose"].to_numpy()])
    return frames[["frame_id", "terrain", "flight", "pose"]]


def _connected_groups(unit: NDArray[np.int64], keys: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Return the group of each row (N,). Rows with the same unit, or an equal value of any key, are in one group.

    Also rows that are connected through other rows. `unit` (N,) has numbers from 0; `keys` are arrays (N,).
    """
    root = np.arange(unit.max(initial=-1) + 1)

    def find(one: int) -> int:
        while root[one] != one:
            root[one] = root[root[one]]
            one = root[one]
        return one

    for key in keys:
        pairs = pd.DataFrame({"key": key, "unit": unit}).drop_duplicates()
        first = pairs.groupby("key")["unit"].transform("first").to_numpy()
        own = pairs["unit"].to_numpy()
        for one, other in zip(first[first != own], own[first != own], strict=True):
            root[find(int(other))] = find(int(one))
    return np.array([find(int(one)) for one in range(len(root))], np.int64)[unit]
