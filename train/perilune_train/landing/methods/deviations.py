"""Compare the stated standard deviations of detected centres with their errors on descents with known poses."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from perilune_train.landing.methods.detector_errors import FrameMatches, paired_errors
from perilune_train.landing.methods.seen import SeenDescent

N_CLASSES = 8
"""Number of classes of equal size, by stated standard deviation."""


def deviation_table(descents: Sequence[tuple[SeenDescent, list[FrameMatches]]]) -> pd.DataFrame:
    """Stated and measured standard deviations of centres per axis, pixels, by stated standard deviation.

    Takes descents with their matches (`matches_of`). One row per class, and a last row for all. Only craters that are
    matched in two consecutive frames count: products of their two errors give the part that persists, differences give
    the part that differs from frame to frame. The error that all sightings of a frame share is removed. The table is
    empty if there are no such craters.
    """
    pairs = pd.concat([paired_errors(descent, matches) for descent, matches in descents], ignore_index=True)
    if not len(pairs):
        return pd.DataFrame()
    stated = np.hypot(pairs["noise_px"], pairs["static_px"])
    edges = np.unique(np.quantile(stated, np.linspace(0, 1, N_CLASSES + 1)))
    number = np.searchsorted(edges[1:-1], stated, side="left")
    rows = [_row(pairs[number == k]) for k in range(len(edges) - 1)]
    return pd.DataFrame([*rows, _row(pairs)])


def _row(pairs: pd.DataFrame) -> dict[str, float]:
    now, before = pairs[["x_px", "y_px"]].to_numpy(), pairs[["before_x_px", "before_y_px"]].to_numpy()
    stated = {name: float(np.sqrt(np.mean(np.square(pairs[f"{name}_px"])))) for name in ("static", "noise")}
    persistent, independent = np.mean(now * before), np.mean((now - before) ** 2) / 2
    variance = (pairs["noise_px"] ** 2 + pairs["static_px"] ** 2).to_numpy()[:, None]
    return {
        "n_pairs": float(len(pairs)),
        "radius_px": float(pairs["radius_px"].median()),
        "stated_px": float(np.hypot(stated["static"], stated["noise"])),
        "error_px": float(np.sqrt(np.mean(now**2))),
        "normalised_error_squared": float(np.mean(now**2 / variance)),
        "stated_static_px": stated["static"],
        "static_px": float(np.sqrt(max(persistent, 0.0))),
        "stated_noise_px": stated["noise"],
        "noise_px": float(np.sqrt(independent)),
    }
