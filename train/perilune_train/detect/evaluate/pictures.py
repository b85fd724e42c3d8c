"""Pictures of an evaluation: precision-recall curves, AP by bin, frames with labels and detections."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle
from numpy.typing import NDArray

from perilune_train.detect.evaluate.bins import BinFigures
from perilune_train.detect.evaluate.evaluation import Evaluation
from perilune_train.detect.evaluate.matching import FALSE, FOUND
from perilune_train.detect.evaluate.metrics import Curve
from perilune_train.records.pictures import save_figure
from perilune_train.records.spread import MIN_UNITS

_LABEL, _IGNORED, _FOUND, _FALSE = "#ff4040", "#e0c030", "#19d3e0", "#ff40ff"
_PANELS = {"radius": "radius, px", "altitude": "altitude, m", "sun": "Sun elevation, degrees"}
_GOAL = 0.85


def draw_curves(curves: dict[str, Curve], path: Path, dashed: dict[str, Curve] | None = None) -> None:
    """Draw precision against recall: solid lines for `curves`, dashed lines for `dashed`, by name."""
    figure = Figure(figsize=(7.5, 4.8), layout="constrained")
    axes = figure.subplots()
    for group, style in ((curves, "-"), (dashed or {}, "--")):
        for name, points in group.items():
            axes.plot(points.recall, points.precision, style, label=name)
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1), fontsize=8)
    save_figure(path, figure)


def draw_bins(bins: Sequence[BinFigures], path: Path) -> None:
    """Draw AP by radius, altitude and Sun as bars.

    Each bar has its 95 % interval and its number of labels. Without an interval, it has a dot per scene, trajectory or
    image. A dashed line shows the goal of 0.85.
    """
    unit = bins[0].ap50_paper_spread.unit if bins else "unit"
    drawn = [(by, title) for by, title in _PANELS.items() if any(part.by == by for part in bins)]
    figure = Figure(figsize=(4.4 * max(len(drawn), 1), 3.8), layout="constrained")
    for column, (by, title) in enumerate(drawn):
        parts = [part for part in bins if part.by == by]
        axes = figure.add_subplot(1, len(drawn), column + 1)
        heights = np.array([part.ap50_paper for part in parts])
        colours = ["#3b7dd8" if part.ap50_paper >= _GOAL else "#d8873b" for part in parts]
        axes.bar(range(len(parts)), heights, color=colours)
        for x, part in enumerate(parts):
            spread = part.ap50_paper_spread
            if spread.interval is None:
                values = list(spread.by_unit.values())
                axes.plot([x] * len(values), values, "o", color="#404040", markersize=3)
            else:
                axes.vlines(x, *spread.interval, color="#404040")
        axes.axhline(_GOAL, linestyle="--", color="black", linewidth=0.8)
        for x, height in enumerate(heights):
            axes.text(x - 0.36, 0.02, f"{height:.2f}", fontsize=8, color="white")
        axes.set(xlabel=title, ylim=(0, 1), ylabel="AP" if column == 0 else "")
        axes.set_xticks(range(len(parts)), [f"{part.label}\n{part.labels}" for part in parts], fontsize=8)
    figure.suptitle(
        f"AP (the paper's definition) with 95 % intervals, or a dot per {unit} if there are fewer than {MIN_UNITS}; "
        "below each bin: number of labels; dashed line: goal of 0.85, reached by blue bars",
        fontsize=9,
    )
    save_figure(path, figure)


def choose_frames(f1: NDArray[np.float64], groups: Sequence[str], count: int) -> dict[str, list[int]]:
    """Choose the `count` best, the `count` typical and the `count` worst frames by their F1 (N,).

    Typical frames have an F1 near the median. Prefers frames of different `groups` (trajectories). Never chooses a
    frame twice. Never chooses a frame without selected labels, whose F1 is NaN.
    """
    known = np.flatnonzero(np.isfinite(f1))
    middle = np.median(f1[known]) if len(known) else 0.0
    orders = {
        "worst": known[np.argsort(f1[known], kind="stable")],
        "best": known[np.argsort(-f1[known], kind="stable")],
        "typical": known[np.argsort(np.abs(f1[known] - middle), kind="stable")],
    }
    used: set[int] = set()
    chosen: dict[str, list[int]] = {}
    for name, order in orders.items():
        picked: list[int] = []
        for others_too in (False, True):
            for index in order.tolist():
                fresh = others_too or groups[index] not in [groups[other] for other in picked]
                if len(picked) < count and index not in used and fresh:
                    picked.append(index)
                    used.add(index)
        chosen[name] = picked
    return {name: chosen[name] for name in ("best", "typical", "worst")}


def draw_frames(evaluation: Evaluation, images: Sequence[NDArray[np.uint8]], path: Path, count: int = 2) -> None:
    """Draw the best, typical and worst frames by F1, each plain and with labels and detections."""
    chosen = choose_frames(evaluation.frame_f1(), evaluation.facts.trajectory, count)
    rows = [(name, index) for name, part in chosen.items() for index in part]
    f1 = evaluation.frame_f1()
    columns = 2 * count
    figure = Figure(figsize=(5 * columns, 5.2 * 3 + 0.5), layout="constrained")
    row_of_name = {"best": 0, "typical": 1, "worst": 2}
    for name, index in rows:
        panel = row_of_name[name] * columns + 2 * chosen[name].index(index)
        plain, drawn = (figure.add_subplot(3, columns, panel + k) for k in (1, 2))
        for axes in (plain, drawn):
            image = images[index]
            axes.imshow(image, cmap="gray", vmin=0, vmax=255, extent=(0, image.shape[1], image.shape[0], 0))
            axes.set(xlim=(0, image.shape[1]), ylim=(image.shape[0], 0))
            axes.axis("off")
        plain.set_title(f"{name}: F1 {f1[index]:.3f}", fontsize=10)
        drawn.set_title(_title(evaluation, index), fontsize=8)
        _draw_marks(drawn, evaluation, index)
    figure.suptitle(
        "labels (ellipses): red (bold if missed), yellow if ignored. Detections (boxes): cyan if matched, magenta if "
        "false positive, white if ignored",
        fontsize=10,
    )
    save_figure(path, figure)


def _title(evaluation: Evaluation, index: int) -> str:
    facts = evaluation.facts
    parts = [facts.name[index]]
    if np.isfinite(facts.altitude_m[index]):
        parts.append(f"{facts.altitude_m[index]:.0f} m")
    if np.isfinite(facts.sun_elevation_deg[index]):
        parts.append(f"Sun {facts.sun_elevation_deg[index]:.0f} deg")
    return ", ".join(parts)


def _draw_marks(axes: Axes, evaluation: Evaluation, index: int) -> None:
    labels, matches, overlaps = evaluation.labels[index], evaluation.matches, evaluation.overlaps
    shown = (matches.frame == index) & (matches.scores >= evaluation.threshold)
    missed = labels.selected.copy()
    missed[matches.label[shown & (matches.label >= 0)] - np.searchsorted(overlaps.label_frame, index)] = False
    known = labels.labelled
    for ellipse, selected, lost in zip(labels.ellipses[known], labels.selected[known], missed[known], strict=True):
        cx, cy, a, b, theta = ellipse
        colour, width = (_LABEL, 1.4 if lost else 0.5) if selected else (_IGNORED, 0.6)
        axes.add_patch(
            Ellipse((cx, cy), 2 * a, 2 * b, angle=np.degrees(theta), fill=False, linewidth=width, color=colour)
        )
    for box, outcome in zip(overlaps.boxes[shown], matches.outcome[shown], strict=True):
        colour = {FOUND: _FOUND, FALSE: _FALSE}.get(int(outcome), "white")
        axes.add_patch(Rectangle(box[:2], *(box[2:] - box[:2]), fill=False, linewidth=0.8, color=colour))
