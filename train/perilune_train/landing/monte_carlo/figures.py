"""Pictures of a Monte Carlo run."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import chi2

from perilune_train.records.pictures import save_figure

_MOST_COLUMNS = 3
_QUANTILES = (0.5, 0.95, 1.0)


def draw_bands(path: Path, rows: pd.DataFrame) -> None:
    """Draw quantiles of the error of position over the draws of each descent, and the stated error."""
    groups = list(rows.groupby(["scene_id", "trajectory_id"]))
    figure, axes = _panels(len(groups))
    for axis, (ids, own) in zip(axes, groups, strict=True):
        stated = 3 * np.sqrt(sum(own[f"sigma_{name}_m"] ** 2 for name in "xyz"))
        by_time = own.assign(stated=stated).groupby("time_s")
        for shade, quantile in zip((0.9, 0.5, 0.25), _QUANTILES, strict=True):
            axis.plot(
                by_time["error_m"].quantile(quantile), color="tab:blue", alpha=shade, label=f"{100 * quantile:g} %"
            )
        axis.plot(by_time["stated"].median(), color="black", linestyle="--", label="3 sigma, stated")
        axis.set(yscale="log", title="/".join(map(str, ids)), xlabel="time (s)", ylabel="error of position (m)")
        axis.grid(alpha=0.3)
    axes[0].legend()
    save_figure(path, figure)


def draw_consistency(path: Path, rows: pd.DataFrame) -> None:
    """Draw the mean normalised error squared over the draws of each descent with its 95 % band."""
    figure = Figure(figsize=(10, 5), layout="constrained")
    axis = figure.subplots()
    for ids, own in rows.groupby(["scene_id", "trajectory_id"]):
        axis.plot(own.groupby("time_s")["squared"].mean(), label="/".join(map(str, ids)))
    draws = rows["draw"].nunique()
    axis.axhspan(
        *(chi2.ppf([0.025, 0.975], 6 * draws) / draws), color="black", alpha=0.15, label="95 % band of the mean"
    )
    axis.axhline(6, color="black", linewidth=1)
    axis.set(yscale="log", xlabel="time (s)", ylabel="mean normalised error squared")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=7, ncols=2)
    save_figure(path, figure)


def _panels(count: int):
    n_columns = min(count, _MOST_COLUMNS)
    n_rows = -(-count // n_columns)
    figure = Figure(figsize=(max(5 * n_columns, 8), 3.2 * n_rows + 0.6), layout="constrained")
    axes = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for unused in axes[count:]:
        unused.axis("off")
    return figure, axes[:count]
