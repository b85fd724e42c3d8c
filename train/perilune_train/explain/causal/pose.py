"""Effect of removed craters on the motion that the stack navigator estimates."""

from typing import Any

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_train.models.navigator import StackNavigator
from perilune_train.navigate.data.trajectories import Trajectory, load_split
from perilune_train.navigate.network import predict


def pose_effects(
    navigator: StackNavigator, architecture: dict[str, Any], factual: Dataset, counterfactual: Dataset, split: str
) -> pd.DataFrame:
    """Errors of each pair of consecutive frames with all craters (before) and without the removed ones (after).

    Columns: frame_id (scene/trajectory/step), scene_id, before, after (position errors, metres), moved_m (length of the
    difference between both estimates). Raises UserError if the counterfactual dataset lacks frames of a trajectory: its
    pairs would not be consecutive; render it with as many frames per trajectory as the dataset has.
    """
    originals = {one.ids: one for one in load_split(factual, split)}
    tables = []
    for changed in load_split(counterfactual, split):
        original = originals.get(changed.ids)
        if original is None or original.n_pairs != changed.n_pairs:
            found = f"{changed.n_pairs + 1} frames of {'/'.join(changed.ids)}"
            raise UserError(counterfactual.store, "frames", found, "all frames of a trajectory of the dataset")
        estimates = [predict(navigator, architecture, one)[0] for one in (original, changed)]
        before, after = (_errors(one, original) for one in estimates)
        steps = ["/".join([*changed.ids, str(step)]) for step in range(changed.n_pairs)]
        moved = np.linalg.norm(estimates[1] - estimates[0], axis=1)
        columns = {"frame_id": steps, "scene_id": changed.ids[0], "before": before, "after": after, "moved_m": moved}
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def _errors(translation_m: np.ndarray, trajectory: Trajectory) -> np.ndarray:
    return np.asarray(np.linalg.norm(translation_m - trajectory.motion[0], axis=1))
