"""Train, val and test dealt out anew."""

from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
from rich.progress import Progress

from perilune_shared.content import terrain_of
from perilune_shared.errors import UserError
from perilune_shared.manifest import Dataset
from perilune_shared.rewrite import ImageMode, rewrite
from perilune_shared.writer import SceneTables, with_column

SplitBy = Literal["scene", "trajectory", "frame"]


def split_dataset(
    source: Dataset,
    out: Path,
    by: SplitBy = "scene",
    val_share: float = 0.1,
    test_share: float = 0.1,
    seed: int = 0,
    images: ImageMode = "link",
    progress: Progress | None = None,
) -> None:
    """Write a dataset whose whole scenes, descents or single frames are dealt to train, val and test at random.

    Scenes with the same ground, whatever their names and Suns, go together, as do all over one elevation model. `frame`
    with shares of 0.1 is the paper's protocol: the same ground in all three splits, which flatters the test, as
    `split_by` in dataset.json then says. At least one unit goes to each split with a share above 0. Raises UserError
    where there are too few.
    """
    if not (0 <= val_share < 1 and 0 <= test_share < 1 and val_share + test_share < 1):
        raise UserError("--val and --test", "shares", f"{val_share}, {test_share}", "from 0 to less than 1 in all")
    frames = source.table("frames", ["frame_id", "scene_id", "trajectory_id"]).to_pandas()
    scenes = source.table("scenes", ["scene_id", "dem_source", "content_sha256"]).to_pandas()
    scenes["terrain"] = [terrain_of(*row) for row in zip(scenes["dem_source"], scenes["content_sha256"], strict=True)]
    frames = frames.merge(scenes, on="scene_id").sort_values("frame_id", ignore_index=True)
    key = {"scene": "terrain", "trajectory": "trajectory", "frame": "frame_id"}[by]
    frames["trajectory"] = frames["scene_id"] + "/" + frames["trajectory_id"]
    units = frames[key].drop_duplicates().to_numpy()
    n_val, n_test = (int(np.ceil(share * len(units))) for share in (val_share, test_share))
    if n_val + n_test >= len(units):
        wanted = f"more than {n_val + n_test}, for train, val and test"
        raise UserError(source.root, "--by", f"{len(units)} of {by}", wanted)
    names = np.array(["train"] * (len(units) - n_val - n_test) + ["val"] * n_val + ["test"] * n_test)
    dealt = dict(zip(units, np.random.default_rng(seed).permutation(names), strict=True))
    split_of = dict(zip(frames["frame_id"], frames[key].map(dealt), strict=True))

    def change(tables: SceneTables) -> SceneTables:
        ids = tables["frames"]["frame_id"].to_pylist()
        splits = pa.array([str(split_of[frame_id]) for frame_id in ids], pa.string())
        return {**tables, "frames": with_column(tables["frames"], "split", splits)}

    line = f"split by {by}, val {val_share:g}, test {test_share:g}, seed {seed}"
    rewrite(source, out, source.info.changed(line), change, images, progress)
