"""Learning curves, and errors of the navigators along a trajectory."""

import logging
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from perilune_train.evaluation.pictures import save_figure
from perilune_train.paper.runs import PaperRuns

_CURVES = {
    "val/ap50_paper": "AP on validation",
    "val/position_rmse_vector_m": "position RMSE on validation, vector (m)",
}


def learning_curve(run: Path, key: str) -> list[float]:
    """Values of a metric after each epoch, from a run's TensorBoard events; the last one of repeated epochs counts."""
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    by_step: dict[int, float] = {}
    for path in sorted(run.glob("events.out.tfevents.*"), key=lambda path: path.stat().st_mtime_ns):
        events = EventAccumulator(str(path))
        events.Reload()
        if key in events.Tags()["scalars"]:
            by_step |= {event.step: event.value for event in events.Scalars(key)}
    return [by_step[step] for step in sorted(by_step)]


def draw_learning(path: Path, runs: PaperRuns) -> None:
    """Draw the learning curves of the detectors and of the navigators."""
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    folders = (
        {network: runs.detector(network) for network in runs.detection()},
        {network: runs.navigator(network) for network in runs.navigation()},
    )
    for axes, own, (key, title) in zip(figure.subplots(1, 2), folders, _CURVES.items(), strict=True):
        for network, folder in own.items():
            values = learning_curve(folder, key)
            axes.plot(range(1, len(values) + 1), values, marker="o", label=network)
        axes.set(xlabel="validation", title=title)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
        axes.legend()
    save_figure(path, figure)


def draw_trajectory_errors(path: Path, runs: PaperRuns) -> None:
    """Draw position and orientation errors of both navigators along the first test trajectory."""
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    axes = figure.subplots(1, 2)
    for network in runs.navigation():
        table = pd.read_parquet(runs.navigator(network) / "errors.parquet")
        own = table[table["method"] == "stack"]
        first = own[own["trajectory_id"] == own["trajectory_id"].iloc[0]]
        for one, column in zip(axes, ("position_error_m", "orientation_error_deg"), strict=True):
            one.plot(first["step"], first[column], label=network)
    name = f"{first['scene_id'].iloc[0]}/{first['trajectory_id'].iloc[0]}"
    for one, title in zip(axes, ("position error (m)", "orientation error (deg)"), strict=True):
        one.set(xlabel="step", title=f"{title}, {name}")
        one.grid(alpha=0.3)
        one.legend()
    save_figure(path, figure)
