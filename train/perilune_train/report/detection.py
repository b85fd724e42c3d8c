"""The report's section on crater detection: figures, curves, AP by bins, best and worst frames."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from perilune_shared.errors import one_line
from perilune_shared.storage.tables.limits import RUN_TABLE
from perilune_shared.storage.tables.read import read_table
from perilune_train.records.spread import MIN_UNITS, read_spread
from perilune_train.report.content import Figure, FramePicture, Section, Table
from perilune_train.report.frames import LabelledFrames
from perilune_train.report.pictures import COLOURS, DASHES, drawing, label_axes, picture_of, plain, svg_of
from perilune_train.report.sources import INSTALLED, Run, sources_of

_ROWS = {
    "ap50_paper": "AP",
    "edge/ap50_paper": "AP, edge scoring rule",
    "strict/ap50_paper": "AP, strict scoring rule",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
    "novel_share": "share of frames unlike the training",
}
_BIN = re.compile(r"(.*?)(radius|altitude|sun)_([0-9.e+]+)_([0-9.e+]+|inf)(?:_(\w+))?/ap50_paper")
_PANELS = {"radius": "radius (px)", "altitude": "altitude (m)", "sun": "Sun elevation (degrees)"}
_EXTREMES = 2
_HATCHES = ("", "///", "...", "xxx")
_CURVE = "precision_recall.parquet"
_COLUMNS = ("score", "precision", "recall")


def detection_section(runs: Sequence[Run], frames: LabelledFrames | None) -> Section:
    """The section on detection runs. `frames` are the test frames with the detections of the last run."""
    pictures = () if frames is None else tuple(extremes(frames))
    return _section(runs, "test/", "detection", "Crater detection", pictures)


def scores_section(scores: Sequence[Run]) -> Section:
    """The section on scores of detectors on the locked benchmark."""
    section = _section(scores, "visible/", "benchmark-detection", "Detection on the locked benchmark", ())
    pictures = [
        Figure(picture_of(path, caption), caption, (score.provenance,), wide=True)
        for score in scores
        for path in sorted((score.folder / "visible").glob("detections.png"))
        for caption in [f"{score.name}: best, typical and worst frames of the benchmark."]
    ]
    return Section(
        section.key, section.title, section.lead, section.tables, (*section.figures, *pictures), section.frames
    )


def headline(run: Run, prefix: str = "test/") -> str:
    """One sentence with the main figures of a run. `prefix` is the start of the metrics' keys."""
    precision, recall = (run.metrics.get(prefix + key) for key in ("precision", "recall"))
    ap, f1 = (_value(run, prefix + key) for key in ("ap50_paper", "f1"))
    who = "The installed detector" if run.name.endswith(INSTALLED) else f"The detector {run.name}"
    if not isinstance(precision, int | float) or not isinstance(recall, int | float):
        return f"{who} has AP {ap}."
    return (
        f"{who} finds {100 * recall:.0f} % of the labelled craters, and {100 * precision:.0f} % of its detections are "
        f"craters (AP {ap}, F1 {f1})."
    )


def extremes(frames: LabelledFrames) -> list[FramePicture]:
    """The two frames with the highest F1 and the two frames with the lowest F1.

    If possible, both best frames are from different trajectories, and so are both worst frames.
    """
    f1 = frames.f1()
    order = [int(index) for index in np.argsort(f1, kind="stable") if np.isfinite(f1[index])]
    table = frames.split.frames.table
    chosen: list[tuple[str, int]] = []
    for word, ranked in (("best", order[::-1]), ("worst", order)):
        picked: list[int] = []
        for others_too in (False, True):
            for index in ranked:
                seen = [(table["scene_id"][k], table["trajectory_id"][k]) for k in picked]
                fresh = (table["scene_id"][index], table["trajectory_id"][index]) not in seen
                used = picked + [k for _, k in chosen]
                if len(picked) < _EXTREMES and index not in used and (fresh or others_too):
                    picked.append(index)
        chosen += [(word, index) for index in picked]
    return [frames.picture(index, f"{word}, F1 {f1[index]:.2f}: ") for word, index in chosen]


def _section(
    runs: Sequence[Run], prefix: str, key: str, title: str, pictures: tuple[FramePicture, ...]
) -> Section:  # fmt: skip
    units = runs[-1].metrics.get(f"{prefix}intervals_units")
    unit = runs[-1].metrics.get(f"{prefix}intervals_over")
    spread = (
        f"95 % intervals over {units} {'trajectories' if unit == 'trajectory' else f'{unit}s'}"
        if isinstance(units, int) and units >= MIN_UNITS
        else f"the value of each {unit or 'unit'}, since there are too few for an interval"
    )
    lead = (
        *(headline(run, prefix) for run in runs),
        *_starts(runs),
        f"In brackets: {spread}. AP is computed by the paper's definition, at IoU 0.5.",
    )
    rows = tuple(
        (text, *(_value(run, prefix + name, spread=True) for run in runs))
        for name, text in _ROWS.items()
        if any(prefix + name in run.metrics for run in runs)
    )
    table = Table("Figures of detection", ("figure", *(run.name for run in runs)), rows, sources_of(runs))
    return Section(key, title, lead, (table,), tuple([*_curves(runs, prefix), *_bins(runs, prefix)]), pictures)


def _starts(runs: Sequence[Run]) -> list[str]:
    """One line for each run that did not start from random weights or that evaluates the installed detector."""
    lines = []
    for run in runs:
        start = run.metrics.get("train/start", "random weights")
        if start != "random weights":
            lines.append(
                f"{run.name} started from {start}; epochs of training on this dataset: {run.metrics['train/epochs']}."
            )
        elif run.name.endswith(INSTALLED):
            lines.append(
                f"{run.name} is the installed detector, which was not trained on this dataset. The frames show it."
            )
    return lines


def _value(run: Run, key: str, *, spread: bool = False) -> str:
    value = run.metrics.get(key)
    if not isinstance(value, int | float):
        return "-"
    return read_spread(run.metrics, key).text(float(value), one_line) if spread else f"{value:.3f}"


def _curves(runs: Sequence[Run], prefix: str) -> list[Figure]:
    """A figure of precision against recall for all runs that have a curve; empty if no run has one."""
    folder = {"visible/": "visible"}.get(prefix, ".")
    drawn = [run for run in runs if (run.folder / folder / _CURVE).is_file()]
    if not drawn:
        return []
    with drawing(height_in=3.8) as figure:
        axes = figure.subplots()
        for number, run in enumerate(drawn):
            curve = read_columns(run.folder / folder / _CURVE, _COLUMNS)
            colour, dash = COLOURS[number % 6], DASHES[number % 6]
            label = f"{plain(run.name)}, IoU 0.5"
            axes.plot(curve["recall"], curve["precision"], color=colour, linestyle=dash, label=label)
            point = [run.metrics.get(f"{prefix}{name}") for name in ("recall", "precision")]
            if all(isinstance(value, int | float) for value in point):
                axes.plot(*point, "o", color=colour, markersize=7)  # type: ignore[arg-type]
        axes.set(xlim=(0, 1), ylim=(0, 1.02))
        label_axes(axes, "Precision against recall", "recall", "precision")
        axes.legend(loc="lower left")
        html = svg_of(figure, "Precision against recall on the test split")
    caption = "Precision against recall at IoU 0.5. The dot is the threshold chosen on validation."
    return [Figure(html, caption, sources_of(drawn))]


def read_columns(path: Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of a run's table as arrays. Raises UserError if a column is missing or the file is damaged."""
    read = read_table(path, RUN_TABLE, dict.fromkeys(columns, "number"))
    return {name: read.numbers(name) for name in columns}


def _bins(runs: Sequence[Run], prefix: str) -> list[Figure]:
    """Figures of AP by radius, altitude and Sun elevation, with the bars of the runs side by side."""
    by_panel: dict[str, dict[str, tuple[float, float, str]]] = {by: {} for by in _PANELS}
    for run in runs:
        for key in run.metrics:
            match = _BIN.fullmatch(key)
            if match and match.group(1) == prefix:
                low, high = float(match.group(3)), float(match.group(4))
                by_panel[match.group(2)][key] = (low, high, key)
    figures = []
    for by, x in _PANELS.items():
        bins = sorted(by_panel[by].values())
        if not bins:
            continue
        with drawing(height_in=3.2) as figure:
            axes = figure.subplots()
            width = 0.8 / len(runs)
            for number, run in enumerate(runs):
                for place, (_, _, key) in enumerate(bins):
                    _bar(axes, run, key, place - 0.4 + (number + 0.5) * width, width, number)
            labels = [
                f"{low:g}–{high:g}" if np.isfinite(high) else f"above {low:g}" for low, high, _ in bins
            ]  # fmt: skip
            axes.set_xticks(range(len(bins)), labels)
            axes.set_ylim(0, 1.05)
            axes.grid(False, axis="x")
            label_axes(axes, f"AP by {x.split(' (')[0]}", x, "AP")
            if len(runs) > 1:
                figure.legend(loc="outside lower center", ncols=2)
            html = svg_of(figure, f"Average precision by {x}")
        names = ", ".join(f"{low:g} to {high:g}" for low, high, _ in bins)
        caption = (
            f"AP in the bins {names} of {x}, with 95 % intervals, or a dot for each unit if there are fewer than "
            f"{MIN_UNITS}."
        )
        figures.append(Figure(html, caption, sources_of(runs)))
    return figures


def _bar(axes, run: Run, key: str, x: float, width: float, number: int) -> None:
    value = run.metrics.get(key)
    if not isinstance(value, int | float):
        return
    label = plain(run.name) if key not in axes.get_legend_handles_labels()[1] else None
    in_legend = [text for text in axes.get_legend_handles_labels()[1] if text == label]
    axes.bar(
        x, value, width, color=COLOURS[number % 6], hatch=_HATCHES[number % 4], edgecolor="white", linewidth=0.3,
        label=None if in_legend else label,
    )  # fmt: skip
    spread = read_spread(run.metrics, key)
    if spread.interval is not None:
        axes.vlines(x, *spread.interval, color="#888888", linewidth=2)
    elif spread.by_unit:
        axes.plot([x] * len(spread.by_unit), list(spread.by_unit.values()), "o", color="#888888", markersize=4)
    axes.text(x, 0.02, f"{value:.2f}", ha="center", va="bottom", color="white", fontsize=8.5, fontweight="bold")
