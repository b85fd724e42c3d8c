"""Compare several navigation runs or evaluations in one table and one picture."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pyarrow as pa

from perilune_shared.errors import UserError
from perilune_shared.export.foreign_text import for_markdown
from perilune_train.motion.metrics.figures import draw_errors
from perilune_train.motion.metrics.floors import FLOORS
from perilune_train.motion.metrics.report import ERRORS_FILE
from perilune_train.records.markdown import number, table, write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import METRICS_FILE, Metrics, read_metrics
from perilune_train.records.spread import read_spread

_COLUMNS = {
    "position_rmse_per_component_m": "position RMSE, per component (m)",
    "position_rmse_vector_m": "position RMSE, vector (m)",
    "orientation_rmse_per_component_deg": "orientation RMSE, per component (deg)",
    "orientation_rmse_angle_deg": "orientation RMSE, angle (deg)",
    "drift_final_m": "drift at the end (m)",
    "ms_per_single_pair": "ms per pair, one at a time",
}
_DRAWN = ["position_error_m", "orientation_error_deg", "error_x_m", "error_y_m", "error_z_m"]


def compare_folders(folders: Sequence[Path], out: Path, allow_overlap: bool = False) -> str:
    """Write compare.md and errors.png into `out`; returns the table.

    Each evaluation has one row for its network, which names a network for poses, and one for each method without
    training of the first evaluation of a dataset and split. Raises UserError if a folder is no evaluation of
    navigation, or was evaluated on terrain that its network was trained on, unless `allow_overlap`; then table and
    picture are marked.
    """
    rows, errors, marks, seen = [], {}, [], set()
    for folder in folders:
        metrics = read_metrics(folder)
        method, split = metrics.get("evaluation/method"), metrics.get("evaluation/split")
        if not isinstance(method, str) or not isinstance(split, str):
            expected = "one of `perilune-train navigate train` or `evaluate`"
            raise UserError(folder / METRICS_FILE, "evaluation/method", method, expected)
        name, mark = _name(folder), metrics.get("terrain/mark")
        if metrics.get("terrain/status") == "overlap" and not allow_overlap:
            expected = "an evaluation on other terrain; --allow-overlap accepts it and marks all output"
            raise UserError(folder / METRICS_FILE, "terrain/mark", mark, expected)
        marks += [f"{name}: {mark}"] if mark else []
        where = [_text(metrics.get(key)) for key in ("dataset/name", "evaluation/split", "dataset/protocol")]
        where += [_text(metrics.get(f"{split}/pairs")), _text(metrics.get("terrain/status"))]
        target = metrics.get("evaluation/target", "motion")
        label = method if target == "motion" else f"{method}, {target}"
        rows.append([for_markdown(f"{name} ({label})"), *where, *_cells(metrics, split)])
        own = _read_errors(folder / ERRORS_FILE)
        errors[name] = own[own["method"] == method]
        for other in ("klt", "nominal", "mean_at_step", "mean", *FLOORS):
            if (target, *where[:-1]) not in seen and f"baseline/{other}/position_rmse_vector_m" in metrics:
                rows.append([other, *where[:-1], "-", *_cells(metrics, f"baseline/{other}")])
        seen.add((target, *where[:-1]))
    head = ["run (network) or method", "dataset", "split", "protocol", "pairs", "terrain", *_COLUMNS.values()]
    text = "\n".join(table(head, rows)) + "\n"
    note = "In brackets: 95 % intervals, or the value of each unit if there are fewer than five."
    write_markdown(out / "compare.md", f"# Comparison of navigation runs\n\n{note}\n\n{text}")
    draw_errors(out / "errors.png", errors)
    mark_files(out, ("compare.md", "errors.png"), "; ".join(marks))
    return text


def _cells(metrics: Metrics, prefix: str) -> list[str]:
    cells = []
    for key in _COLUMNS:
        value = metrics.get(f"{prefix}/{key}")
        found = float(value) if isinstance(value, int | float) else None
        cells.append(number(None) if found is None else read_spread(metrics, f"{prefix}/{key}").text(found))
    return cells


def _read_errors(path: Path) -> pd.DataFrame:
    """Read the table of pairs. Raises UserError if it is missing or another table."""
    if not path.is_file():
        raise UserError(path, "errors", "no such file", "one that `perilune-train navigate train` or `evaluate` writes")
    try:
        return pd.read_parquet(path, columns=["method", *_DRAWN])
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise UserError(path, "errors", error, f"columns method, {', '.join(_DRAWN)}") from None


def _name(folder: Path) -> str:
    """Name of a run, or run/evaluation for an evaluation of it."""
    parts = folder.resolve().parts
    return parts[-1] if (folder / "checkpoints").is_dir() else "/".join(parts[-2:])


def _text(value: object) -> str:
    return "-" if value is None else for_markdown(value)
