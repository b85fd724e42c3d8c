"""Effect of removed craters on the motion or pose that the stack navigator estimates."""

from collections import Counter
from typing import Any

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_train.data.frames import frame_table
from perilune_train.models.navigator import StackNavigator
from perilune_train.motion.data.trajectories import load_split
from perilune_train.motion.network import predict, target_of
from perilune_train.motion.pose import predict_pose

_TRAJECTORY = ["scene_id", "trajectory_id"]


def pose_effects(
    navigator: StackNavigator, architecture: dict[str, Any], factual: Dataset, counterfactual: Dataset, split: str
) -> pd.DataFrame:
    """Errors of each pair of consecutive frames with all craters (before) and without the removed ones (after).

    Columns: frame_id (scene/trajectory/step), scene_id, before, after (position errors, metres), moved_m (length of the
    difference between both estimates). Raises UserError if the counterfactual dataset lacks frames of a trajectory: its
    pairs would not be consecutive; render it with as many frames per trajectory as the dataset has.
    """
    check_descents(factual, counterfactual, split)
    originals = {one.ids: one for one in load_split(factual, split)}
    of_pose, tables = target_of(architecture) == "pose", []
    predicted = predict_pose if of_pose else predict
    for changed in load_split(counterfactual, split):
        original = originals[changed.ids]
        estimates = [predicted(navigator, architecture, one)[0] for one in (original, changed)]
        truth_m = original.pose[0] if of_pose else original.motion[0]
        before, after = (np.linalg.norm(one - truth_m, axis=1) for one in estimates)
        steps = ["/".join([*changed.ids, str(step)]) for step in range(changed.n_pairs)]
        moved = np.linalg.norm(estimates[1] - estimates[0], axis=1)
        columns = {"frame_id": steps, "scene_id": changed.ids[0], "before": before, "after": after, "moved_m": moved}
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def check_descents(factual: Dataset, counterfactual: Dataset, split: str) -> None:
    """Raise UserError unless the trajectories of a split of the second dataset have all frames of the first one."""
    whole, changed = (
        Counter(frame_table(one, split)[_TRAJECTORY].agg("/".join, axis=1)) for one in (factual, counterfactual)
    )
    for trajectory, count in changed.items():
        if whole[trajectory] != count:
            found = f"{count} frames of {trajectory}"
            expected = "all frames of a trajectory of the dataset; render with --frames-per-trajectory 1000"
            raise UserError(counterfactual.store, "frames", found, expected)
