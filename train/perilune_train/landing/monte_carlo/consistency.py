"""Tables of a Monte Carlo run: consistency and accuracy by altitude, and bounds of each descent."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from perilune_shared.geometry.frames import Array
from perilune_train.landing.monte_carlo.statistics import (
    BOUND_SHARE,
    CONFIDENCE,
    ellipse,
    mean_band,
    quantile_bound,
    share_bound,
    supported_share,
)

WRONG_SQUARED = 60.0
"""Largest normalised squared error that does not count as wrong. With six degrees of freedom and a correct covariance,
a share of 5e-11 of all errors is larger."""
_POSE_PARTS = 6
_PERCENTILES = (2.5, 97.5)
DESCENT = ["scene_id", "trajectory_id"]


def is_silently_wrong(rows: pd.DataFrame) -> pd.Series:
    """Whether each row has a large normalised error while its status is not `lost`."""
    return (rows["squared"] > WRONG_SQUARED) & (rows["status"] != "lost")


def by_altitude(rows: pd.DataFrame) -> pd.DataFrame:
    """One row for each frame of each descent, over its draws. Columns:

    - scene_id, trajectory_id, time_s, altitude_m, n_draws
    - position_rmse_m, position_low_m, position_high_m: root mean square and 2.5 and 97.5 percentiles of the position
      error
    - nees, nees_low, nees_high: mean normalised (pose) error squared and its 95 % band
    - nis, nis_low, nis_high: normalised innovation squared divided by the number of its parts, and its 95 % band; NaN
      if no draw matched the frame
    - major_m, minor_m, azimuth_deg: horizontal 95 % ellipse of the errors about zero
    - stated_major_m, stated_minor_m, stated_azimuth_deg: this ellipse from the mean stated covariance
    """
    return pd.DataFrame([_of_frame(*key, frame) for key, frame in _frames(rows)])


def _frames(rows: pd.DataFrame) -> Iterator[tuple[tuple[str, str, float], pd.DataFrame]]:
    for (scene, trajectory, time_s), frame in rows.groupby([*DESCENT, "time_s"]):
        yield (str(scene), str(trajectory), float(str(time_s))), frame


def _of_frame(scene: str, trajectory: str, time_s: float, frame: pd.DataFrame) -> dict[str, object]:
    n, error = len(frame), frame["error_m"]
    low, high = np.percentile(error, _PERCENTILES)
    nees_low, nees_high = mean_band(_POSE_PARTS, n)
    matched = frame[frame["n_innovations"] > 0]
    parts = int(matched["n_innovations"].sum())
    nis_low, nis_high = mean_band(1, parts) if parts else (np.nan, np.nan)
    offsets = frame[["error_x_m", "error_y_m"]].to_numpy()
    found, stated = ellipse(offsets.T @ offsets / n), ellipse(stated_covariance(frame))
    names = ("major_m", "minor_m", "azimuth_deg")
    return {
        "scene_id": scene,
        "trajectory_id": trajectory,
        "time_s": time_s,
        "altitude_m": float(frame["altitude_m"].mean()),
        "n_draws": n,
        "position_rmse_m": float(np.sqrt(np.mean(np.square(error)))),
        "position_low_m": float(low),
        "position_high_m": float(high),
        "nees": float(frame["squared"].mean()),
        "nees_low": float(nees_low),
        "nees_high": float(nees_high),
        "nis": float(matched["innovation_squared"].sum() / parts) if parts else float("nan"),
        "nis_low": float(nis_low),
        "nis_high": float(nis_high),
        **dict(zip(names, found, strict=True)),
        **dict(zip((f"stated_{name}" for name in names), stated, strict=True)),
    }


def stated_covariance(frame: pd.DataFrame) -> Array:
    """Mean horizontal covariance (2, 2) that the filter states in the draws of a frame."""
    xx, yy = (float(np.mean(np.square(frame[f"sigma_{axis}_m"]))) for axis in "xy")
    xy = float(frame["covariance_xy_m2"].mean())
    return np.array([[xx, xy], [xy, yy]])


def of_descents(rows: pd.DataFrame, frames: pd.DataFrame) -> pd.DataFrame:
    """One row for each descent; `frames` is the result of `by_altitude`. Columns:

    - scene_id, trajectory_id, n_draws, end_altitude_m
    - position_rmse_m, position_low_m, position_high_m: root mean square over all frames and draws, and 2.5 and 97.5
      percentiles of the root mean square of a flight
    - miss_median_m, miss_largest_m: horizontal error at the last frame
    - miss_99_bound_m: upper bound, with 95 % confidence, of 99 % of the miss distances; NaN with too few draws
    - supported_share: largest share of the miss distances that the draws bound, by `miss_largest_m`
    - nees_in_band_share, nis_in_band_share: share of the frames in the 95 % band
    - silently_wrong_flights, silently_wrong_share_bound: flights with a silently wrong frame, and the upper bound, with
      95 % confidence, of their share
    - ends_silently_wrong, ends_silently_wrong_share_bound: the same for the last frame
    """
    table = []
    for (scene, trajectory), descent in rows.groupby(DESCENT):
        in_time = descent.sort_values("time_s")
        flights = in_time.assign(
            silent=is_silently_wrong(in_time),
            error_squared=in_time["error_m"] ** 2,
        ).groupby("draw")
        ends, n = flights.last(), flights.ngroups
        rmse = np.sqrt(flights["error_squared"].mean())
        miss = np.hypot(ends["error_x_m"].to_numpy(), ends["error_y_m"].to_numpy())
        low, high = np.percentile(rmse, _PERCENTILES)
        silent, ends_silent = int(flights["silent"].any().sum()), int(ends["silent"].sum())
        own = frames[(frames["scene_id"] == scene) & (frames["trajectory_id"] == trajectory)]
        table.append(
            {
                "scene_id": str(scene),
                "trajectory_id": str(trajectory),
                "n_draws": n,
                "end_altitude_m": float(ends["altitude_m"].mean()),
                "position_rmse_m": float(np.sqrt(np.mean(np.square(descent["error_m"])))),
                "position_low_m": float(low),
                "position_high_m": float(high),
                "miss_median_m": float(np.median(miss)),
                "miss_largest_m": float(miss.max()),
                "miss_99_bound_m": quantile_bound(miss, BOUND_SHARE, CONFIDENCE),
                "supported_share": supported_share(n, CONFIDENCE),
                "nees_in_band_share": in_band_share(own, "nees"),
                "nis_in_band_share": in_band_share(own, "nis"),
                "silently_wrong_flights": silent,
                "silently_wrong_share_bound": share_bound(silent, n),
                "ends_silently_wrong": ends_silent,
                "ends_silently_wrong_share_bound": share_bound(ends_silent, n),
            }
        )
    return pd.DataFrame(table)


def in_band_share(frames: pd.DataFrame, name: str) -> float:
    """Share of the frames whose `nees` or `nis` lies in its band; NaN without frames."""
    known = frames[frames[name].notna()]
    return float(known[name].between(known[f"{name}_low"], known[f"{name}_high"]).mean())
