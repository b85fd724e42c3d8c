"""The page of a Monte Carlo run, with its figures and pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import chi2

from perilune_shared.export.foreign_text import code_span, for_markdown
from perilune_train.landing.methods.flights import flight_summary
from perilune_train.landing.monte_carlo.scenario import SCENARIOS, Draws
from perilune_train.records.markdown import number, table
from perilune_train.records.pictures import save_figure

WRONG_SQUARED = 60.0
"""Largest normalised squared error that does not count as wrong. With six degrees of freedom and a correct covariance,
a share of 5e-11 of all errors is larger."""
_COLUMNS = {
    "position_rmse_m": "position RMSE (m)",
    "position_end_rmse_m": "position RMSE at the end (m)",
    "position_end_95_m": "95th percentile at the end (m)",
    "position_end_worst_m": "largest error at the end (m)",
    "attitude_rmse_deg": "attitude RMSE (deg)",
    "normalised_error_squared_mean": "normalised error squared (expected 6)",
    "in_band_share": "frames in the 95 % band",
    "lost_share": "frames lost",
    "silently_wrong_share": "frames silently wrong",
    "ends_silently_wrong": "flights that end silently wrong",
}
_CAPTIONS = {
    "errors.png": "Position error over all draws: median, 95th percentile, maximum; dashed: median stated 3 sigma",
    "consistency.png": "Mean normalised error squared over the draws of a descent; 6 if the covariance is correct",
}
_MAX_COLUMNS = 3
_QUANTILES = (0.5, 0.95, 1.0)


def run_summary(rows: pd.DataFrame) -> dict[str, float]:
    """Figures over all frames of all draws, from the columns of draws.parquet."""
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
    return {
        (str(scene), str(trajectory)): run_summary(trajectory_rows) for (scene, trajectory), trajectory_rows in groups
    }


def page_of(dataset: str, split: str, draws: Draws, rows: pd.DataFrame, seconds: float, pictures: Sequence[str]) -> str:
    """The page as Markdown."""
    overall, by_descent = run_summary(rows), by_trajectory(rows)
    n_flights = len(rows.groupby(["scene_id", "trajectory_id", "draw"]))
    cells = [["all", *_cells(overall)]]
    cells += [[for_markdown("/".join(map(str, ids))), *_cells(figures)] for ids, figures in by_descent.items()]
    lines = [
        "# Monte Carlo of the navigation filter",
        "",
        f"Dataset {code_span(dataset)}, split {for_markdown(split)}, "
        f"scenario `{draws.scenario}`: {SCENARIOS[draws.scenario]}.",
        f"Descents: {len(by_descent)}, with {draws.count} draws of each, {n_flights} flights, {len(rows)} frames, seed "
        f"{draws.seed}; {seconds / 60:.1f} minutes.",
        "",
        f"The draws vary the initial errors (60 m, 1 m/s and {draws.attitude_deg:g} degrees on each axis), the errors "
        "of the tactical inertial unit, and of the catalogue (1 m, 3 % of the diameter, 10 % missing, 5 % false). "
        "Detections and ranges are not drawn: all draws of a descent use the recorded ones, with the same errors. "
        "The spread over draws therefore shows the effect of the drawn errors, not the effect of other terrain.",
        "",
        "A frame is silently wrong if its normalised error squared is above 60 and its status is not `lost`.",
        "",
        *table(["Descent", *_COLUMNS.values()], cells),
    ]
    for name in pictures:
        lines += ["", f"![{_CAPTIONS[name]}]({name})", "", f"*{_CAPTIONS[name]}.*"]
    return "\n".join(lines) + "\n"


def _cells(figures: Mapping[str, float]) -> list[str]:
    return [_cell(key, figures[key]) for key in _COLUMNS]


def _cell(key: str, value: float) -> str:
    if key == "ends_silently_wrong":
        return f"{value:.0f}"
    if not np.isfinite(value):
        return "-"
    return f"{100 * value:.2f} %" if key.endswith("_share") else number(float(value))


def draw_bands(path: Path, rows: pd.DataFrame) -> None:
    """Draw quantiles of the position error over the draws of each descent, and the stated error."""
    groups = list(rows.groupby(["scene_id", "trajectory_id"]))
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


def draw_consistency(path: Path, rows: pd.DataFrame) -> None:
    """Draw the mean normalised error squared over the draws of each descent with its 95 % band."""
    figure = Figure(figsize=(10, 5), layout="constrained")
    axis = figure.subplots()
    for ids, descent in rows.groupby(["scene_id", "trajectory_id"]):
        axis.plot(descent.groupby("time_s")["squared"].mean(), label="/".join(map(str, ids)))
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
    n_columns = min(count, _MAX_COLUMNS)
    n_rows = -(-count // n_columns)
    figure = Figure(figsize=(max(5 * n_columns, 8), 3.2 * n_rows + 0.6), layout="constrained")
    axes = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for unused in axes[count:]:
        unused.axis("off")
    return figure, axes[:count]
