"""Tables, pictures and metrics of an evaluation of navigation."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from perilune_shared.geometry.frames import Array
from perilune_shared.storage.files import written_aside
from perilune_train.evaluation.marks import mark_files
from perilune_train.evaluation.metrics_file import Metrics, write_metrics
from perilune_train.navigate.data.trajectories import Motion, Trajectory
from perilune_train.navigate.evaluate.figures import draw_errors, draw_trajectory
from perilune_train.navigate.evaluate.metrics import motion_errors, summary, summary_spreads

ERRORS_FILE = "errors.parquet"
_WRITTEN = ("navigation.parquet", ERRORS_FILE, "descent.png", "errors.png")


def write_evaluation(
    folder: Path,
    own: str,
    split: str,
    trajectories: list[Trajectory],
    motions: Mapping[str, list[Motion]],
    covariances: Mapping[str, list[Array]],
    details: Mapping[str, float | int | str | None],
) -> None:
    """Write the errors of all methods on the trajectories of a split.

    Writes navigation.parquet (one row per method), errors.parquet (one row per pair), descent.png, errors.png and
    metrics.json: <split>/<figure> for the method `own`, <method>/<figure> for another network, baseline/<method>/...
    for the others, and `details`, which have the mark of the terrain check.
    """
    errors = {method: motion_errors(trajectories, found, covariances.get(method)) for method, found in motions.items()}
    rows = {method: summary(table) for method, table in errors.items()}
    _write_table(folder / "navigation.parquet", pd.DataFrame([{"method": m, **row} for m, row in rows.items()]))
    pairs = pd.concat([table.assign(method=method) for method, table in errors.items()], ignore_index=True)
    _write_table(folder / ERRORS_FILE, pairs)
    drawn = {method: found[0] for method, found in motions.items() if method != "mean"}
    draw_trajectory(folder / "descent.png", trajectories[0], drawn, errors)
    draw_errors(folder / "errors.png", errors)
    metrics: Metrics = {"evaluation/method": own, "evaluation/split": split}
    for method, row in rows.items():
        prefix = method if method in ("stack", "warp") else f"baseline/{method}"
        prefix = split if method == own else prefix
        metrics |= {f"{prefix}/{key}": value for key, value in row.items()}
        for key, spread in summary_spreads(errors[method]).items():
            metrics |= spread.keys(f"{prefix}/{key}")
    mark_files(folder, _WRITTEN, str(details["terrain/mark"]))
    write_metrics(folder, metrics | dict(details))


def _write_table(path: Path, table: pd.DataFrame) -> None:
    with written_aside(path) as aside:
        table.to_parquet(aside, index=False)
