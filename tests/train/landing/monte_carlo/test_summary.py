"""Figures of many flights, by hand."""

import numpy as np
import pandas as pd

from perilune_train.landing.monte_carlo.page import by_trajectory, run_summary


def rows():
    """Two descents, two draws, two frames; one frame is silently wrong, one wrong and said to be lost."""
    table = pd.DataFrame(
        {
            "scene_id": "scene-0000",
            "trajectory_id": np.repeat(["trajectory-0000", "trajectory-0001"], 4),
            "draw": [0, 0, 1, 1] * 2,
            "time_s": [0.0, 1.0] * 4,
            "error_m": [3.0, 1.0, 3.0, 2.0, 3.0, 40.0, 3.0, 50.0],
            "turn_deg": 0.1,
            "squared": [6.0, 6.0, 6.0, 20.0, 6.0, 70.0, 6.0, 90.0],
            "status": ["tracking"] * 5 + ["coasting", "tracking", "lost"],
        }
    )
    return table


def test_figures_count_every_frame_and_flight():
    figures = run_summary(rows())
    assert figures["n_frames"] == 8
    assert np.isclose(figures["position_end_rmse_m"], np.sqrt((1 + 4 + 1600 + 2500) / 4))
    assert figures["position_end_worst_m"] == 50
    assert figures["in_band_share"] == 5 / 8
    assert figures["lost_share"] == 1 / 8
    assert figures["silently_wrong_share"] == 1 / 8
    assert figures["ends_silently_wrong"] == 1


def test_descents_are_told_apart():
    own = by_trajectory(rows())
    assert list(own) == [("scene-0000", "trajectory-0000"), ("scene-0000", "trajectory-0001")]
    first, second = own.values()
    assert (first["position_end_worst_m"], second["position_end_worst_m"]) == (2, 50)
    assert (first["ends_silently_wrong"], second["ends_silently_wrong"]) == (0, 1)
