"""Compare several evaluations in one table and one picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from perilune_shared.errors import UserError
from perilune_shared.export.foreign_text import for_markdown
from perilune_shared.storage.tables.limits import RUN_TABLE
from perilune_shared.storage.tables.read import read_table
from perilune_train.detect.evaluate.figures import draw_curves
from perilune_train.detect.evaluate.metrics import Curve
from perilune_train.detect.evaluate.report import CURVE_FILE
from perilune_train.records.markdown import number, table, write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import METRICS_FILE, Metrics, read_metrics
from perilune_train.records.provenance import Status, TerrainCheck
from perilune_train.records.spread import read_spread

_COLUMNS = {
    "ap50_paper": "AP",
    "edge/ap50_paper": "edge AP",
    "strict/ap50_paper": "strict AP",
    "ap50_95_paper": "AP 0.50:0.95",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
}
_LOWEST = {f"lowest_ap50_paper_by_{by}": f"lowest AP by {by}" for by in ("radius", "altitude", "sun")}


def compare_folders(folders: Sequence[Path], out: Path, allow_overlap: bool = False) -> str:
    """Write compare.md and precision_recall.png into `out`; returns the table.

    Raises UserError if a folder has no metrics or no curve, or was evaluated on terrain that its network was trained
    on, unless `allow_overlap`; then table and picture are marked.
    """
    rows, curves, marks = [], {}, []
    for folder in folders:
        metrics = read_metrics(folder)
        name = _name(folder)
        if any(key.rpartition("/")[2] == "ap50" for key in metrics):
            raise UserError(
                folder / METRICS_FILE,
                "ap50",
                "the interpolated AP of an earlier release",
                "ap50_paper: run `perilune-train detect evaluate` again",
            )
        if "images/name" in metrics:
            # An evaluation on real images; its keys have no split as prefix.
            split, figures, selection = "images", metrics, f"from {metrics.get('min_size_px')} px"
            entries: list[object] = [metrics.get("images/name"), split, None, selection, metrics.get("scales")]
        else:
            split = str(metrics.get("evaluation/split", "test"))
            figures = {key.removeprefix(f"{split}/"): metrics[key] for key in metrics if key.startswith(f"{split}/")}
            entries = [metrics.get("dataset/name"), split, metrics.get("dataset/protocol")]
            entries += [metrics.get("labels/selection"), metrics.get("evaluation/scales", 1)]
        status, mark = _terrain(folder, metrics, allow_overlap)
        marks += [f"{name}: {mark}"] if mark else []
        entries.insert(3, status)
        cells = [for_markdown(name), *map(_text, (*entries, figures.get("frames"), figures.get("labels")))]
        cells += [_cell(figures, key) for key in _COLUMNS]
        rows.append(cells + [number(figures.get(key)) for key in _LOWEST])
        # AP of the whole curve, not of the saved points.
        label = f"{len(rows)} {name}, {split}: AP {number(figures.get('ap50_paper'))}"
        curves[label] = read_curve(folder / CURVE_FILE)
    head = ["run", "dataset", "split", "protocol", "terrain", "selection", "scales", "frames", "labels"]
    head += [*_COLUMNS.values(), *_LOWEST.values()]
    text = "\n".join(table(head, rows)) + "\n"
    write_markdown(
        out / "compare.md",
        "# Comparison of runs\n\n"
        "In brackets: 95 % intervals, or the value of each unit if there are fewer than five.\n\n" + text,
    )
    draw_curves(curves, out / "precision_recall.png")
    mark_files(out, ("compare.md", "precision_recall.png"), "; ".join(marks))
    return text


def _terrain(folder: Path, metrics: Metrics, allow_overlap: bool) -> tuple[str, str]:
    """Terrain status of an evaluation, and the mark for its output ("" for none)."""
    if "images/name" in metrics:
        return "real images", ""
    status, mark = metrics.get("terrain/status"), metrics.get("terrain/mark")
    if status == "overlap" and not allow_overlap:
        expected = "an evaluation on other terrain; --allow-overlap accepts it and marks all output"
        raise UserError(folder / METRICS_FILE, "terrain/mark", mark, expected)
    known = status in get_args(Status) and isinstance(mark, str)
    return (str(status), str(mark)) if known else ("unknown", TerrainCheck("unknown").mark)


def read_curve(path: Path) -> Curve:
    """Read the curve of an evaluation. Raises UserError if it is missing or another table."""
    columns = read_table(path, RUN_TABLE, {"score": "number", "precision": "number", "recall": "number"})
    return Curve(*(columns.numbers(name) for name in ("score", "precision", "recall")))


def _name(folder: Path) -> str:
    """Name of a run, or run/evaluation for an evaluation of it."""
    parts = folder.resolve().parts
    return "/".join(parts[-2:]) if not (folder / "checkpoints").is_dir() else parts[-1]


def _text(value: object) -> str:
    return "-" if value is None else for_markdown(value)


def _cell(figures: dict, key: str) -> str:
    value = figures.get(key)
    return read_spread(figures, key).text(value) if isinstance(value, int | float) else number(value)
