"""Consistency of a linear filter with Gaussian errors: correct in its bands, over-confident outside of them."""

import numpy as np
import pandas as pd
import pytest

from perilune_train.landing.monte_carlo.consistency import by_altitude, of_descents
from perilune_train.landing.monte_carlo.page import Run, page_of
from perilune_train.landing.monte_carlo.scenario import Draws
from perilune_train.landing.monte_carlo.statistics import share_bound

N_FRAMES, STEP_S, SIGMA_M, SHAKEN = 40, 1.5, 2.0, 0.3


def filtered(rng, assumed_share=1.0):
    """One flight of a filter of position and velocity in three axes, and of a constant attitude, as rows.

    The filter assumes `assumed_share` times the true deviations of its measurements and of its process noise.
    """
    move = np.eye(9)
    move[:3, 3:6] = STEP_S * np.eye(3)
    noise = np.diag(np.repeat([SHAKEN**2 * STEP_S**2 / 4, SHAKEN**2, 1e-8], 3))
    see = np.eye(9)[np.r_[:3, 6:9]]
    measured = np.diag(np.repeat([SIGMA_M**2, 1e-6], 3))
    start = np.repeat([60.0, 1.0, 0.01], 3)
    error, covariance = start * rng.normal(size=9), np.diag(start**2)
    rows = []
    for k in range(N_FRAMES):
        innovation = np.sqrt(np.diag(measured)) * rng.normal(size=6) - see @ error
        spread = see @ covariance @ see.T + assumed_share**2 * measured
        gain = covariance @ see.T @ np.linalg.inv(spread)
        error, covariance = error + gain @ innovation, covariance - gain @ see @ covariance
        pose, own = see @ error, see @ covariance @ see.T
        rows.append(
            {
                "time_s": k * STEP_S,
                "altitude_m": 1500.0 - 1300 * k / (N_FRAMES - 1),
                "status": "tracking",
                **{f"error_{axis}_m": value for axis, value in zip("xyz", pose, strict=False)},
                **{f"sigma_{axis}_m": value for axis, value in zip("xyz", np.sqrt(np.diag(own)), strict=False)},
                "error_m": np.linalg.norm(pose[:3]),
                "turn_deg": np.degrees(np.linalg.norm(pose[3:])),
                "squared": pose @ np.linalg.solve(own, pose),
                "covariance_xy_m2": own[0, 1],
                "innovation_squared": innovation @ np.linalg.solve(spread, innovation),
                "n_innovations": 6,
            }
        )
        error = move @ error + np.sqrt(np.diag(noise)) * rng.normal(size=9)
        covariance = move @ covariance @ move.T + assumed_share**2 * noise
    return rows


def flights(assumed_share=1.0, n_draws=60, seed=0):
    tables = []
    for draw in range(n_draws):
        rows = filtered(np.random.default_rng([seed, draw]), assumed_share)
        tables.append(pd.DataFrame(rows).assign(scene_id="scene-0000", trajectory_id="trajectory-0000", draw=draw))
    return pd.concat(tables, ignore_index=True)


@pytest.mark.parametrize(("assumed_share", "is_consistent"), [(1.0, True), (0.7, False), (1.5, False)])
def test_only_a_correct_filter_lies_in_its_bands(assumed_share, is_consistent):
    """A filter that assumes smaller errors than it has is above its bands, and one that assumes larger errors below."""
    rows = flights(assumed_share)
    frames = by_altitude(rows)
    descents = of_descents(rows, frames)
    for name in ("nees", "nis"):
        share = descents[f"{name}_in_band_share"].item()
        later = frames.iloc[5:]
        if is_consistent:
            assert share >= 0.8
        else:
            assert share < 0.5
            outside = later[name] > later[f"{name}_high"] if assumed_share < 1 else later[name] < later[f"{name}_low"]
            assert outside.mean() > 0.8
    ratio = frames["major_m"] / frames["stated_major_m"]
    assert (abs(ratio.median() - 1) < 0.2) == is_consistent
    assert len(frames) == N_FRAMES
    assert (frames["position_low_m"] < frames["position_rmse_m"]).all()
    assert (frames["position_rmse_m"] < frames["position_high_m"]).all()


def page(rows):
    frames = by_altitude(rows)
    n_draws = rows["draw"].nunique()
    run = Run("linear", "val", Draws(count=n_draws), 60.0, (), "detector_errors.json")
    descents = of_descents(rows, frames)
    return page_of(run, rows, frames, descents), descents.iloc[0]


def test_a_page_states_no_bound_that_its_draws_do_not_support():
    text, descent = page(flights(n_draws=60))
    assert np.isnan(descent["miss_99_bound_m"])
    assert "needs 299 draws of a descent. 60 draws do not support it" in text
    assert "bounds 95.1 % of the flights" in text
    assert "too few draws" in text
    assert "over 1 scene" in text and "no interval over scenes" in text


def test_a_page_states_the_bound_that_its_draws_support():
    rows = pd.concat([flights(n_draws=300).query("time_s > 55")])
    text, descent = page(rows)
    ends = rows[rows["time_s"] == rows["time_s"].max()]
    miss_m = np.hypot(ends["error_x_m"], ends["error_y_m"])
    assert descent["miss_99_bound_m"] == miss_m.max() == descent["miss_largest_m"]
    assert "300 draws support it" in text and "too few draws" not in text
    assert "60 flights per minute" not in text and "300 flights per minute" in text


def test_silently_wrong_flights_are_counted_once_and_bounded():
    rows = flights(n_draws=10)
    wrong = (rows["draw"] == 3) & rows["time_s"].between(10, 20) | (rows["draw"] == 5) & (rows["time_s"] == 15)
    lost = (rows["draw"] == 6) & (rows["time_s"] > 50)
    rows.loc[wrong | lost, "squared"] = 100.0
    rows.loc[lost, "status"] = "lost"
    descent = of_descents(rows, by_altitude(rows)).iloc[0]
    assert descent["silently_wrong_flights"] == 2
    assert descent["ends_silently_wrong"] == 0
    assert descent["silently_wrong_share_bound"] == share_bound(2, 10)
    assert 0.25 < descent["ends_silently_wrong_share_bound"] < 0.27
