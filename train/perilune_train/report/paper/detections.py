"""Detections of a finished run on its test split: widths of large craters, and pictures like the paper's."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import open_single
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.ellipses import correlations_of
from perilune_train.detect.evaluate.matching import Detections, find_overlaps
from perilune_train.detect.evaluate.split_evaluation import ELLIPSE_COLUMNS
from perilune_train.detect.finished_run import config_of_run, threshold_of_table
from perilune_train.records.pictures import save_figure
from perilune_train.records.spread import Interval, Resamples, draw_resamples, spreads

LARGE_PX = (20.0, 50.0)
"""Radii of large craters, pixels."""
_BOX = ["x0_px", "y0_px", "x1_px", "y1_px"]


@dataclass(frozen=True)
class Detected:
    """A run's detections on its test split."""

    split: DetectSplit
    """Test frames and labels."""
    found: list[Detections]
    """Detections at or above the run's threshold, one entry per frame."""


def read_detections(run: Path, dataset: Address, trained: Path | None = None) -> Detected:
    """Read a run's detections. Raises UserError if they are missing, damaged or not from the test split.

    `trained` is the folder of the training run, which has the settings and the threshold; by default it is `run`.
    """
    trained = trained or run
    split = load_split(open_single(dataset), "test", config_of_run(trained).labels)
    path = run / "detections.parquet"
    if not path.is_file():
        raise UserError(path, "detections", "no such file", "the detections of a finished run")
    try:
        stored = set(pq.read_schema(path).names)
        # Tables of older versions have no ellipses.
        ellipses = list(ELLIPSE_COLUMNS) if stored.issuperset(ELLIPSE_COLUMNS) else []
        table = pd.read_parquet(path, columns=["frame_id", *_BOX, "score", *ellipses])
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise UserError(path, "detections", error, f"columns frame_id, {', '.join(_BOX)}, score") from None
    for name in (*_BOX, "score"):
        if not pd.api.types.is_numeric_dtype(table[name]):
            raise UserError(path, name, table[name].dtype, "finite numbers")
        unusable = table[name][~np.isfinite(table[name])]
        if len(unusable):
            raise UserError(path, name, unusable.iloc[0], "finite numbers")
    table = table[table["score"] >= threshold_of_table(run)]
    of_frame = {str(name): rows for name, rows in table.groupby("frame_id")}
    names = split.frames.table["frame_id"].tolist()
    unknown = set(of_frame) - set(names)
    if unknown:
        raise UserError(path, "frame_id", min(unknown), f"a test frame of {dataset}")
    parts = [of_frame.get(name, table.iloc[:0]) for name in names]
    return Detected(split, [_detections(part, ellipses) for part in parts])


def _detections(rows: pd.DataFrame, ellipses: list[str]) -> Detections:
    """The detections of a frame. Without standard deviations, the detector predicts no ellipses."""
    boxes, scores = rows[_BOX].to_numpy(np.float64), rows["score"].to_numpy(np.float64)
    if not ellipses or not np.isfinite(rows[ellipses].to_numpy(np.float64)).all():
        return Detections(boxes, scores)
    semi_major, semi_minor, angle_deg, *sigmas_px = rows[ellipses].to_numpy(np.float64).T
    centres = (boxes[:, :2] + boxes[:, 2:]) / 2
    shape = np.column_stack([centres, semi_major, semi_minor, np.radians(angle_deg)])
    return Detections(boxes, scores, np.column_stack([correlations_of(shape), *sigmas_px]))


@dataclass(frozen=True)
class WidthRatio:
    """Width of detected large craters, divided by the width of their labels."""

    median: float
    """Median over the craters."""
    interval: Interval | None
    """95 % interval over scenes, or over trajectories of one scene; None with fewer than five units."""


def width_ratio(detected: Detected) -> WidthRatio | None:
    """Width of the detected large craters relative to their labels; None if no large crater was detected."""
    split = detected.split
    height, width = split.frames.images.shape[1:]
    sizes = np.tile((width, height), (len(split), 1))
    overlaps = find_overlaps(detected.found, list(split.labels), sizes)
    matches = overlaps.match(0.5, split.radius_px)
    hit = matches.label >= 0
    radius_px = overlaps.label_radius_px[matches.label[hit]]
    ours, truth = overlaps.boxes[hit], overlaps.label_boxes[matches.label[hit]]
    large = (radius_px >= LARGE_PX[0]) & (radius_px <= LARGE_PX[1])
    ratios = ((ours[:, 2] - ours[:, 0]) / (truth[:, 2] - truth[:, 0]))[large]
    if not len(ratios):
        return None
    order, frames = np.argsort(ratios), matches.frame[hit][large]

    def medians(resamples: Resamples) -> dict[str, NDArray[np.float64]]:
        weights = np.cumsum(resamples.weights[:, resamples.of_row[frames[order]]], axis=1)
        # A resample without large craters has no median, so it gives NaN.
        middle = (weights < weights[:, -1:] / 2).sum(axis=1)
        return {"ratio": np.where(weights[:, -1] > 0, ratios[order][np.minimum(middle, len(ratios) - 1)], np.nan)}

    table = split.frames.table
    scenes, trajectories, ids = (list(map(str, table[name])) for name in ("scene_id", "trajectory_id", "frame_id"))
    resamples = draw_resamples(scenes, trajectories, ids, np.random.default_rng(0))
    return WidthRatio(float(np.median(ratios)), spreads(medians, frames, resamples)["ratio"].interval)


def draw_detections(path: Path, by_network: dict[str, Detected]) -> None:
    """Draw the labels and detections of the frames with the smallest and the largest craters.

    Ground truth is red and detections are cyan, as in the paper. Frames with less than a quarter of the largest number
    of labels are not considered.
    """
    split = next(iter(by_network.values())).split
    counts = np.array([int(labels.selected.sum()) for labels in split.labels])
    radii = np.array(
        [labels.radius_px[labels.selected].mean() if any(labels.selected) else 0 for labels in split.labels]
    )
    candidates = np.flatnonzero(counts >= max(1, counts.max() // 4))
    chosen = {
        "small craters": int(candidates[np.argmin(radii[candidates])]),
        "large craters": int(candidates[np.argmax(radii[candidates])]),
    }
    figure = Figure(figsize=(6 * len(chosen), 6.3 * len(by_network)), layout="constrained")
    axes = np.atleast_2d(figure.subplots(len(by_network), len(chosen), squeeze=False))
    for row, (network, detected) in zip(axes, by_network.items(), strict=True):
        for panel, (what, index) in zip(row, chosen.items(), strict=True):
            image = split.frames.images[index]
            panel.imshow(image, cmap="gray", vmin=0, vmax=255, extent=(0, image.shape[1], image.shape[0], 0))
            labels = split.labels[index]
            for boxes, colour in ((labels.boxes[labels.selected], "red"), (detected.found[index].boxes, "cyan")):
                for x0, y0, x1, y1 in boxes:
                    panel.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, linewidth=0.8, color=colour))
            panel.set(xlim=(0, image.shape[1]), ylim=(image.shape[0], 0))
            panel.set_title(f"{network}, {what}: {split.frames.table['frame_id'][index]}", fontsize=9)
            panel.axis("off")
    save_figure(path, figure)
