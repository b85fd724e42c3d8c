"""Figures of a Monte Carlo run."""

import numpy as np
import pandas as pd

from perilune_train.landing.methods.flights import flight_summary

WRONG_SQUARED = 60.0
"""Normalised error squared of six parts that a right covariance exceeds in 5e-11 of all cases."""


def run_summary(rows: pd.DataFrame) -> dict[str, float]:
    """Figures over all frames of all draws, none left out. Columns as of draws.parquet."""
    flight = rows[["trajectory_id", "draw"]].astype(str).agg("/".join, axis=1)
    flights = rows.assign(seconds=np.nan, flight=flight)
    figures = flight_summary(flights.assign(trajectory_id=flights["flight"]))
    ends = flights.groupby(["scene_id", "flight"]).last()
    silent = (rows["squared"] > WRONG_SQUARED) & (rows["status"] != "lost")
    return figures | {
        "position_end_95_m": float(ends["error_m"].quantile(0.95)),
        "lost_share": float((rows["status"] == "lost").mean()),
        "silently_wrong_share": float(silent.mean()),
        "ends_silently_wrong": float(((ends["squared"] > WRONG_SQUARED) & (ends["status"] != "lost")).sum()),
    }


def by_trajectory(rows: pd.DataFrame) -> dict[tuple[str, str], dict[str, float]]:
    """Figures of each descent over its draws."""
    groups = rows.groupby(["scene_id", "trajectory_id"])
    return {(str(scene), str(trajectory)): run_summary(own) for (scene, trajectory), own in groups}
