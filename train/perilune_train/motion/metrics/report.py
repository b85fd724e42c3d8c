"""Write the tables, pictures and metrics of an evaluation of navigation."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from perilune_shared.export.foreign_text import for_markdown
from perilune_shared.storage.files import written_aside
from perilune_train.motion.data.trajectories import Pose, Trajectory
from perilune_train.motion.metrics.baselines import MethodMotions
from perilune_train.motion.metrics.errors import motion_errors, pose_errors, pose_summary, summary, summary_spreads
from perilune_train.motion.metrics.floors import FLOORS
from perilune_train.motion.metrics.pictures import draw_errors, draw_pose_errors, draw_trajectory
from perilune_train.records.markdown import number, table, write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import Metrics, write_metrics
from perilune_train.records.spread import read_spread

ERRORS_FILE = "errors.parquet"
POSE_PAGE = "pose.md"
_POSE_COLUMNS = {
    "position_rmse_per_component_m": "position RMSE, per component (m)",
    "position_rmse_vector_m": "vector (m)",
    "position_error_median_m": "median (m)",
    "orientation_rmse_per_component_deg": "orientation RMSE, per component (deg)",
    "orientation_rmse_angle_deg": "angle (deg)",
}
_WRITTEN = ("navigation.parquet", ERRORS_FILE, "descent.png", "errors.png")


def write_evaluation(
    folder: Path,
    network: str,
    split: str,
    trajectories: list[Trajectory],
    estimates: MethodMotions,
    details: Mapping[str, float | int | str | None],
) -> None:
    """Write the errors of all methods on the trajectories of a split.

    Writes navigation.parquet (one row per method), errors.parquet (one row per pair), descent.png, errors.png and
    metrics.json. Keys of metrics.json: <split>/<figure> for the method `network`, <method>/<figure> for another
    network, baseline/<method>/<figure> for the other methods. `details` are further entries of metrics.json, among them
    terrain/mark, the mark of the terrain check.
    """
    errors = {
        method: motion_errors(trajectories, motions, estimates.covariances.get(method))
        for method, motions in estimates.motions.items()
    }
    rows = {method: summary(table) for method, table in errors.items()}
    _write_tables(folder, errors, rows)
    drawn = {method: motions[0] for method, motions in estimates.motions.items() if method != "mean"}
    draw_trajectory(folder / "descent.png", trajectories[0], drawn, errors)
    draw_errors(folder / "errors.png", errors)
    mark_files(folder, _WRITTEN, str(details["terrain/mark"]))
    write_metrics(folder, _metrics(network, split, errors, rows) | dict(details))


def write_pose_evaluation(
    folder: Path,
    network: str,
    split: str,
    trajectories: list[Trajectory],
    poses: Mapping[str, list[Pose]],
    details: Mapping[str, float | int | str | None],
) -> str:
    """Write the errors of a pose network and its floors on the trajectories of a split; return the page.

    Writes pose.md, errors.png, and the tables and metrics of `write_evaluation`. Floors are the baselines of floors.py.
    The metric evaluation/worse_than names the floor with the lowest position RMSE if the network is not better.
    """
    errors = {method: pose_errors(trajectories, entries) for method, entries in poses.items()}
    rows = {method: pose_summary(table) for method, table in errors.items()}
    _write_tables(folder, errors, rows)
    draw_pose_errors(folder / "errors.png", errors, network)
    metrics = _metrics(network, split, errors, rows)
    worse_than = worse_than_floor(network, rows)
    page = _pose_page(network, split, metrics, list(errors), worse_than)
    write_markdown(folder / POSE_PAGE, page)
    mark_files(folder, (*_WRITTEN, POSE_PAGE), str(details["terrain/mark"]))
    entries: Metrics = {"evaluation/target": "pose", "evaluation/worse_than": worse_than}
    write_metrics(folder, metrics | entries | dict(details))
    return page


def worse_than_floor(network: str, rows: Mapping[str, Mapping[str, float]]) -> str:
    """Name of the floor with the lowest position RMSE if `network` is not better; otherwise empty."""
    key = "position_rmse_per_component_m"
    best = min((method for method in rows if method != network), key=lambda method: rows[method][key], default=network)
    return best if best != network and rows[best][key] <= rows[network][key] else ""


def _pose_page(network: str, split: str, metrics: Metrics, methods: list[str], worse_than: str) -> str:
    cells = []
    for method in methods:
        prefix = _prefix(method, network, split)
        name = (
            f"**{method}, worse than {worse_than}**" if method == network and worse_than else FLOORS.get(method, method)
        )
        cells.append([name, *[_with_interval(metrics, f"{prefix}/{key}") for key in _POSE_COLUMNS]])
    text = "In brackets: 95 % intervals over trajectories, if there are five or more."
    lines = ["# Pose in the landing frame", "", f"Split {for_markdown(split)}. {text}", ""]
    return "\n".join([*lines, *table(["method", *_POSE_COLUMNS.values()], cells), ""])


def _with_interval(metrics: Metrics, key: str) -> str:
    value, spread = metrics.get(key), read_spread(metrics, key)
    # Without an interval, the spread lists the value of every trajectory, which would fill the table.
    return spread.text(float(value)) if spread.interval and isinstance(value, int | float) else number(value)


def _metrics(
    network: str, split: str, errors: Mapping[str, pd.DataFrame], rows: Mapping[str, Mapping[str, float]]
) -> Metrics:
    metrics: Metrics = {"evaluation/method": network, "evaluation/split": split}
    for method, row in rows.items():
        prefix = _prefix(method, network, split)
        metrics |= {f"{prefix}/{key}": value for key, value in row.items()}
        for key, spread in summary_spreads(errors[method]).items():
            metrics |= spread.keys(f"{prefix}/{key}")
    return metrics


def _prefix(method: str, network: str, split: str) -> str:
    """Prefix of a method's keys in metrics.json."""
    if method == network:
        return split
    return method if method in ("stack", "warp") else f"baseline/{method}"


def _write_tables(folder: Path, errors: Mapping[str, pd.DataFrame], rows: Mapping[str, Mapping[str, float]]) -> None:
    _write_table(folder / "navigation.parquet", pd.DataFrame([{"method": m, **row} for m, row in rows.items()]))
    pairs = pd.concat([table.assign(method=method) for method, table in errors.items()], ignore_index=True)
    _write_table(folder / ERRORS_FILE, pairs)


def _write_table(path: Path, table: pd.DataFrame) -> None:
    with written_aside(path) as aside:
        table.to_parquet(aside, index=False)
