"""Pictures of a detection run: precision-recall curve, and frames with labels and detections drawn."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle

from perilune_shared.files import written_aside
from perilune_train.detect.data import DetectSplit
from perilune_train.detect.metrics import Curve, Detections

matplotlib.use("Agg")
_LABEL, _IGNORED, _DETECTED = "#ff4040", "#c9a227", "#19d3e0"


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    with written_aside(path) as aside:
        figure.savefig(aside, dpi=110)


def draw_curve(curves: dict[str, Curve], path: Path) -> None:
    """Precision against recall, one line for each account."""
    figure = Figure(figsize=(5, 4), layout="constrained")
    axes = figure.subplots()
    for name, points in curves.items():
        axes.plot(points.recall, points.precision, label=f"{name}: AP {points.average_precision():.3f}")
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(loc="lower left")
    save_figure(figure, path)


def draw_detections(split: DetectSplit, found: list[Detections], threshold: float, path: Path, count: int = 6) -> None:
    """A contact sheet of `count` evenly spaced frames: wanted and ignored labels as ellipses, detections as boxes."""
    chosen = np.unique(np.linspace(0, len(split) - 1, count + 2).astype(int)[1:-1])
    columns = min(len(chosen), 3)
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(4.6 * columns, 4.6 * rows + 0.4), layout="constrained")
    for place in range(rows * columns):
        axes = figure.add_subplot(rows, columns, place + 1)
        axes.axis("off")
        if place >= len(chosen):
            continue
        index = chosen[place]
        image = split.frames.images[index]
        axes.imshow(image, cmap="gray", vmin=0, vmax=255, extent=(0, image.shape[1], image.shape[0], 0))
        labels = split.labels[index]
        known = labels.labelled
        for (cx, cy, a, b, theta), wanted in zip(labels.ellipses[known], labels.wanted[known], strict=True):
            colour = _LABEL if wanted else _IGNORED
            turned_deg = np.degrees(theta)
            axes.add_patch(Ellipse((cx, cy), 2 * a, 2 * b, angle=turned_deg, fill=False, linewidth=0.9, color=colour))
        for box in found[index].boxes[found[index].scores >= threshold]:
            size = box[2:] - box[:2]
            axes.add_patch(Rectangle(box[:2], *size, fill=False, linewidth=0.9, color=_DETECTED))
        axes.set(xlim=(0, image.shape[1]), ylim=(image.shape[0], 0))
        axes.set_title(split.frames.table["frame_id"][index], fontsize=8)
    figure.suptitle("labels red, hardly visible ones yellow, detections cyan", fontsize=9)
    save_figure(figure, path)
