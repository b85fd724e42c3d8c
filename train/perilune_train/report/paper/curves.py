"""Draw AP against crater density, learning curves, and the errors of the navigators along a trajectory."""

import logging
from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from perilune_train.records.metrics_file import Metrics
from perilune_train.records.pictures import save_figure
from perilune_train.report.paper.claimed import TARGET_AP

_AP_LINES = {
    "val/ap50_paper": "validation, usual scoring",
    "test/ap50_paper": "test, usual scoring",
    "test/strict/ap50_paper": "test, strict scoring",
}
AP_KEY = "val/ap50_paper"
POSITION_KEY = "val/position_rmse_vector_m"
_TITLES = {AP_KEY: "AP on validation", POSITION_KEY: "position RMSE on validation, vector (m)"}
_TRAJECTORY = ["scene_id", "trajectory_id"]
_ERRORS = {"position_error_m": "position error (m)", "orientation_error_deg": "orientation error (deg)"}


def draw_curve(path: Path, curve: Mapping[str, Metrics], headline: str | None) -> None:
    """Draw AP of YOLOv3 against equilibrium_share, with lines at the paper's AP and at the headline ground.

    The shares are evenly spaced along the axis.
    """
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    shares = list(curve)
    for key, name in _AP_LINES.items():
        heights = [curve[share].get(key) for share in shares]
        known = [(position, value) for position, value in enumerate(heights) if isinstance(value, int | float)]
        axes.plot([position for position, _ in known], [value for _, value in known], marker="o", label=name)
    axes.axhline(TARGET_AP, color="black", linestyle="--", label=f"the paper's YOLOv3, {TARGET_AP:.3f}")
    if headline in shares:
        axes.axvline(shares.index(headline), color="gray", linestyle=":", label="headline ground")
    axes.set_xticks(range(len(shares)), shares)
    axes.set(xlabel="equilibrium_share", ylabel="AP", ylim=(0, 1.02), title="YOLOv3 without attention")
    axes.grid(alpha=0.3)
    axes.legend()
    save_figure(path, figure)


def learning_curve(run: Path, key: str) -> list[float]:
    """Values of a metric at each validation, from a run's TensorBoard events. A repeated step has its last value."""
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    by_step: dict[int, float] = {}
    for path in sorted(run.glob("events.out.tfevents.*"), key=lambda path: path.stat().st_mtime_ns):
        events = EventAccumulator(str(path))
        events.Reload()
        if key in events.Tags()["scalars"]:
            by_step |= {event.step: event.value for event in events.Scalars(key)}
    return [by_step[step] for step in sorted(by_step)]


def draw_learning(path: Path, panels: Mapping[str, tuple[str, Mapping[str, Path]]]) -> bool:
    """Draw learning curves, one panel per title; returns whether there are any curves.

    `panels` has, by title, the key of a metric and the folders of the runs by name.
    """
    values = {
        title: {name: heights for name, run in runs.items() if (heights := learning_curve(run, key))}
        for title, (key, runs) in panels.items()
    }
    values = {title: heights for title, heights in values.items() if heights}
    if not values:
        return False
    figure = Figure(figsize=(6 * len(values), 4.5), layout="constrained")
    for axes, (title, curves) in zip(figure.subplots(1, len(values), squeeze=False)[0], values.items(), strict=True):
        for name, heights in curves.items():
            axes.plot(range(1, len(heights) + 1), heights, marker="o", label=name)
        axes.set(xlabel="validation", ylabel=_TITLES[panels[title][0]], title=title)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
        axes.legend()
    save_figure(path, figure)
    return True


def draw_trajectory_errors(path: Path, readings: Mapping[str, Mapping[str, Path]]) -> bool:
    """Draw the errors of each network along the first test trajectory; returns whether there are any errors.

    `readings` has the path of errors.parquet by reading (a key of `READINGS`) and network. Each reading has a row.
    """
    tables = {
        reading: {network: _first_trajectory(file) for network, file in files.items() if file.is_file()}
        for reading, files in readings.items()
    }
    tables = {reading: errors for reading, errors in tables.items() if errors}
    if not tables:
        return False
    figure = Figure(figsize=(12, 4.5 * len(tables)), layout="constrained")
    grid = figure.subplots(len(tables), 2, squeeze=False)
    for row, (reading, errors) in zip(grid, tables.items(), strict=True):
        for axes, (column, title) in zip(row, _ERRORS.items(), strict=True):
            for network, table in errors.items():
                axes.plot(table["step"], table[column], label=network)
            name = "/".join(next(iter(errors.values()))[_TRAJECTORY].iloc[0])
            axes.set(xlabel="step", title=f"{reading}: {title}, {name}")
            axes.grid(alpha=0.3)
            axes.legend()
    save_figure(path, figure)
    return True


def _first_trajectory(file: Path) -> pd.DataFrame:
    table = pd.read_parquet(file)
    rows = table[table["method"] == "stack"]
    return rows[(rows[_TRAJECTORY] == rows[_TRAJECTORY].iloc[0]).all(axis=1)]
