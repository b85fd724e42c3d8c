"""Pictures of a Monte Carlo run."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from perilune_shared.geometry.frames import Array
from perilune_train.landing.monte_carlo.consistency import DESCENT, stated_covariance
from perilune_train.landing.monte_carlo.statistics import BOUND_SHARE, ellipse, quantile_bound
from perilune_train.records.pictures import save_figure

ALTITUDES_M = (1400.0, 1000.0, 600.0, 300.0, 200.0)
"""Altitudes at which error ellipses are drawn and tabulated, each from the frame that is nearest to it."""
MAX_ELLIPSES = 4
"""Largest number of descents whose ellipses are drawn."""
_MAX_COLUMNS = 3
_QUANTILES = (0.5, 0.95, 1.0)


def draw_bands(path: Path, rows: pd.DataFrame) -> None:
    """Draw quantiles of the position error over the draws of each descent, and the stated error."""
    groups = list(rows.groupby(DESCENT))
    figure, axes = _panels(len(groups))
    for axis, (ids, descent) in zip(axes, groups, strict=True):
        stated = 3 * np.sqrt(sum(descent[f"sigma_{name}_m"] ** 2 for name in "xyz"))
        by_time = descent.assign(stated=stated).groupby("time_s")
        for shade, quantile in zip((0.9, 0.5, 0.25), _QUANTILES, strict=True):
            axis.plot(
                by_time["error_m"].quantile(quantile), color="tab:blue", alpha=shade, label=f"{100 * quantile:g} %"
            )
        axis.plot(by_time["stated"].median(), color="black", linestyle="--", label="stated 3 sigma")
        axis.set(yscale="log", title="/".join(map(str, ids)), xlabel="time (s)", ylabel="position error (m)")
        axis.grid(alpha=0.3)
    axes[0].legend()
    save_figure(path, figure)


def draw_consistency(path: Path, frames: pd.DataFrame) -> None:
    """Draw NEES and NIS of each descent by altitude with their 95 % bands, from the table of `by_altitude`."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    axes = figure.subplots(1, 2)
    names = {"nees": ("mean normalised error squared", 6), "nis": ("normalised innovation squared per part", 1)}
    for axis, (name, (label, expected)) in zip(axes, names.items(), strict=True):
        for ids, descent in frames.groupby(DESCENT):
            axis.plot(descent["altitude_m"], descent[name], label="/".join(map(str, ids)))
        # The band of the innovations depends on the number of matches: draw the widest one.
        low, high = frames[f"{name}_low"].min(), frames[f"{name}_high"].max()
        axis.axhspan(low, high, color="black", alpha=0.15, label="95 % band")
        axis.axhline(expected, color="black", linewidth=1)
        axis.set(yscale="log", xlabel="altitude (m)", ylabel=label)
        axis.invert_xaxis()
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=7, ncols=2)
    save_figure(path, figure)


def at_altitudes(rows: pd.DataFrame) -> list[pd.DataFrame]:
    """The draws of one descent at the frames nearest to `ALTITUDES_M`, without repeated frames."""
    altitude_m = rows.groupby("time_s")["altitude_m"].mean()
    times = dict.fromkeys((altitude_m - wanted).abs().idxmin() for wanted in ALTITUDES_M)
    return [rows[rows["time_s"] == time_s] for time_s in times]


def draw_ellipses(path: Path, rows: pd.DataFrame) -> None:
    """Draw horizontal errors of the draws and 95 % ellipses, measured and stated, at some altitudes."""
    groups = list(rows.groupby(DESCENT))[:MAX_ELLIPSES]
    figure = Figure(figsize=(2.6 * len(ALTITUDES_M), 2.9 * len(groups) + 0.4), layout="constrained")
    axes = figure.subplots(len(groups), len(ALTITUDES_M), squeeze=False)
    for (ids, descent), line in zip(groups, axes, strict=True):
        frames = at_altitudes(descent)
        for axis, frame in zip(line, frames, strict=False):
            offsets = frame[["error_x_m", "error_y_m"]].to_numpy()
            measured, stated = offsets.T @ offsets / len(offsets), stated_covariance(frame)
            reach = 1.15 * max(ellipse(measured)[0], ellipse(stated)[0])
            axis.plot(*offsets.T, ".", color="tab:blue", markersize=3, alpha=0.5)
            _outline(axis, measured, color="tab:blue", label="95 % of the errors")
            _outline(axis, stated, color="black", linestyle="--", label="95 %, as stated")
            title = f"{frame['altitude_m'].mean():.0f} m"
            axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", title=title)
            axis.grid(alpha=0.3)
        for axis in line[len(frames) :]:
            axis.axis("off")
        line[0].set_ylabel("/".join(map(str, ids)) + "\nerror in y (m)", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("error in x (m)")
    axes[0, 0].legend(fontsize=7, loc="upper left")
    save_figure(path, figure)


def _outline(axis: Axes, covariance: Array, **style: Any) -> None:
    major, minor, azimuth_deg = ellipse(covariance)
    turn, angle = np.radians(azimuth_deg), np.linspace(0, 2 * np.pi, 100)
    along, across = major * np.cos(angle), minor * np.sin(angle)
    axis.plot(
        along * np.cos(turn) - across * np.sin(turn),
        along * np.sin(turn) + across * np.cos(turn),
        linewidth=1.2,
        **style,
    )


def draw_miss(path: Path, rows: pd.DataFrame) -> None:
    """Draw the distribution of the horizontal error at the last frame of each descent, with its bound."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axis = figure.subplots()
    for number, (ids, descent) in enumerate(rows.groupby(DESCENT)):
        ends = descent[descent["time_s"] == descent["time_s"].max()]
        miss_m = np.sort(np.hypot(ends["error_x_m"], ends["error_y_m"]))
        colour = f"C{number % 10}"
        axis.step(
            miss_m,
            np.arange(1, len(miss_m) + 1) / len(miss_m),
            where="post",
            color=colour,
            label="/".join(map(str, ids)),
        )
        bound_m = quantile_bound(miss_m, BOUND_SHARE)
        if np.isfinite(bound_m):
            axis.plot([bound_m], [BOUND_SHARE], "v", color=colour)
    axis.set(xlabel="miss distance at the last frame (m)", ylabel="share of the draws", ylim=(0, 1.02))
    axis.set_xlim(left=0)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=7)
    save_figure(path, figure)


def _panels(count: int):
    n_columns = min(count, _MAX_COLUMNS)
    n_rows = -(-count // n_columns)
    figure = Figure(figsize=(max(5 * n_columns, 8), 3.2 * n_rows + 0.6), layout="constrained")
    axes = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for unused in axes[count:]:
        unused.axis("off")
    return figure, axes[:count]
