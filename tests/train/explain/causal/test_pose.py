"""Poses with and without craters, with a navigator that reads the brightness of the frames."""

import numpy as np
import pytest
from tests.helpers.drawn_dataset import build_dataset

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.explain.causal import effects as pose
from perilune_train.explain.causal.effects import pose_effects
from perilune_train.motion.data.trajectories import load_split

_NAV = {"splits": {"train": 1, "val": 1, "test": 2}, "scenes": 2, "n_frames": 4}


@pytest.fixture
def predicted(monkeypatch):
    """The truth, moved along x by the mean grey value of the earlier frame in metres."""

    def predict(navigator, architecture, trajectory):
        translation, rotation = trajectory.motion
        grey = trajectory.images[:-1].mean((1, 2))
        return translation + grey[:, None] * [1.0, 0, 0], rotation

    monkeypatch.setattr(pose, "predict", predict)


def test_errors_and_moves_are_those_of_the_estimates(predicted, tmp_path):
    every = {f"s00{k}": range(220) for k in range(2)}
    factual, without = (
        open_dataset(build_dataset(tmp_path / name, "nav", removed=removed, **_NAV))
        for name, removed in (("all", None), ("without", every))
    )
    table = pose_effects(None, {}, factual, without, "test")
    assert list(table.columns) == ["frame_id", "scene_id", "before", "after", "moved_m"]
    assert len(table) == 6 and table["scene_id"].tolist() == ["s000"] * 3 + ["s001"] * 3
    assert table["frame_id"].tolist()[0] == "s000/t002/0"
    grey = [
        np.concatenate([one.images[:-1].mean((1, 2)) for one in load_split(dataset, "test")])
        for dataset in (factual, without)
    ]
    np.testing.assert_allclose(table["before"], grey[0])
    np.testing.assert_allclose(table["after"], grey[1])
    np.testing.assert_allclose(table["moved_m"], np.abs(grey[0] - grey[1]), atol=1e-9)
    assert table["moved_m"].min() > 0
    same = pose_effects(None, {}, factual, factual, "test")
    assert (same["moved_m"] == 0).all() and (same["before"] == same["after"]).all()


def test_descents_with_missing_frames_are_refused(predicted, tmp_path):
    factual = open_dataset(build_dataset(tmp_path / "all", "nav", **_NAV))
    fewer = open_dataset(build_dataset(tmp_path / "fewer", "nav", **_NAV | {"n_frames": 3}))
    with pytest.raises(UserError, match=r"frames: got 3 frames of s000/t002, expected all frames of a trajectory"):
        pose_effects(None, {}, factual, fewer, "test")
