import numpy as np
import pytest

from perilune_train.detect.evaluate.report import spread_note
from perilune_train.records.spread import draw_resamples


@pytest.mark.parametrize(
    ("scenes", "words"),
    [
        (6, "resamples of 6 scenes"),
        (1, "resamples of 6 trajectories"),
        (2, "the value of each scene; at least 5 scenes"),
    ],
)
def test_the_note_names_the_units(scenes, words):
    names = [f"scene-{k % scenes}" for k in range(6)]
    trajectories = [f"{name}/trajectory-{k}" for k, name in enumerate(names)]
    drawn = draw_resamples(names, trajectories, trajectories, np.random.default_rng(0))
    assert words in spread_note(drawn)
