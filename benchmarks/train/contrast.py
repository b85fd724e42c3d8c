"""How well the labels' contrast separates craters that a trained detector finds from those that it misses.

`python -m benchmarks.train.contrast DATASET RUN` takes a dataset and a detect run on it. Evaluates on the validation
split, where the rule `visible` is chosen, or on another --split, for the craters of `visible` without its contrast
threshold: the area under the ROC curve (AUC) of contrast, depth ratio and radius, overall and by radius; the fraction
found by contrast and radius, for several limits of the pixels that count (`contrast_pixels`); and the metrics of the
run's detections with each selection. A crater is found if a detection with a score of at least the run's threshold has
an IoU of at least 0.5 with it; detections are matched in order of score. Writes runs/bench/contrast.json, and with
--picture FRAME_ID contrast.jpg, an enlarged frame, plain and coloured by contrast.
"""

from itertools import pairwise
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import pandas as pd
import typer
from numpy.typing import NDArray

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.geometry.frames import Array
from perilune_shared.labels.selection import limited_contrast, read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_train.detect.config import LabelSettings
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.bins import RADIUS_BINS_PX
from perilune_train.detect.evaluate.boxes import iou_matrix
from perilune_train.detect.evaluate.matching import Detections, match_split
from perilune_train.detect.evaluate.metrics import figures
from perilune_train.detect.finished_run import chosen_threshold, config_of_run
from perilune_train.detect.inference.detector import open_run
from perilune_train.detect.inference.scales import detect_split

_BOX = ["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]
_ELLIPSE = ["ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px", "ellipse_theta_rad"]
_EDGES = (-1e9, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, np.inf)
_PIXELS = (60, 100, 150, 200, 250, 300, 400, 600, None)
"""Limits of the pixels that count, None for no limit."""
_STEPS = (2, 3, 4, 5, 6, 7)
"""Lower ends of the steps of contrast."""
_COLOURS = ((2.0, (60, 60, 255)), (4.0, (0, 150, 255)), (8.0, (0, 235, 235)), (np.inf, (80, 220, 80)))
"""Upper bounds of contrast with their colours (blue, green, red)."""
_SCALE = 4


def auc(values: Array, found: NDArray[np.bool_]) -> float | None:
    """Area under the ROC curve of values (N,) for `found` (N,).

    It is the fraction of pairs of a found and a missed crater in which the found one has the larger value. A tie counts
    half. None if there are no such pairs.
    """
    rank = pd.Series(values).rank().to_numpy()
    n, m = int(found.sum()), int((~found).sum())
    return float((rank[found].sum() - n * (n + 1) / 2) / (n * m)) if n and m else None


def found_by(labels: pd.DataFrame, detections: dict[str, Detections], threshold: float) -> NDArray[np.bool_]:
    """Whether each label (N,) is found: in order of score, each detection takes the unmatched label of highest IoU."""
    found = np.zeros(len(labels), np.bool_)
    for frame_id, rows in labels.groupby("frame_id").indices.items():
        own = detections.get(str(frame_id))
        if own is None:
            continue
        overlap = iou_matrix(own.boxes[own.scores >= threshold], labels[_BOX].to_numpy()[rows])
        free = np.ones(len(rows), np.bool_)
        for row in overlap:
            best = int(np.where(free, row, -1.0).argmax())
            if free[best] and row[best] >= 0.5:
                free[best] = False
        found[rows] = ~free
    return found


def measure(dataset: Dataset, detections: dict[str, Detections], threshold: float, split: str) -> dict:
    """AUC and fraction found, for contrast.json."""
    labels = read_labels(dataset, _BOX, split)
    labels = labels[selected(labels, SELECTIONS["visible"].model_copy(update={"min_contrast": None}))]
    labels = labels.reset_index(drop=True)
    labels["depth_ratio"] = labels["depth_m"] / labels["diameter_m"]
    found = found_by(labels, detections, threshold)
    radius, contrast = labels["radius_px"].to_numpy(), labels["contrast"].to_numpy()
    table: dict[str, dict] = {}
    for low, high in [(2.0, 50.0), *pairwise(RADIUS_BINS_PX)]:
        own = (radius >= low) & (radius <= high)
        columns = ("contrast", "depth_ratio", "radius_px")
        table[f"{low:g}-{high:g} px"] = {
            "labels": int(own.sum()),
            "found": float(found[own].mean()) if own.any() else None,
            **{name: auc(labels[name].to_numpy()[own], found[own]) for name in columns},
        }
    shares: list[dict] = []
    for low, high in pairwise(_EDGES):
        own = (contrast >= low) & (contrast < high)
        share = float(found[own].mean()) if own.any() else None
        shares.append({"from": low, "labels": int(own.sum()), "found": share})
    limits = {str(pixels): by_limit(contrast, radius, found, pixels) for pixels in _PIXELS}
    return {"auc": table, "found_by_contrast": shares, "by_contrast_pixels": limits}


def by_limit(contrast: Array, radius_px: Array, found: NDArray[np.bool_], pixels: float | None) -> dict:
    """AUC of the limited contrast, and the fraction found and number of labels by radius in steps of contrast."""
    values = limited_contrast(contrast, radius_px, pixels)
    result: dict = {"auc": auc(values, found)}
    for low, high in pairwise(RADIUS_BINS_PX[:-1]):
        for step in _STEPS:
            own = (radius_px >= low) & (radius_px < high) & (values >= step) & (values < step + 1)
            share = float(found[own].mean()) if own.any() else None
            result[f"{low:g}-{high:g} px/{step}-{step + 1}"] = {"labels": int(own.sum()), "found": share}
    return result


def evaluate(dataset: Dataset, detections: dict[str, Detections], threshold: float, split_name: str) -> dict:
    """Evaluate the detections with each selection, and with `visible` without its contrast threshold."""
    settings = {name: LabelSettings(selection=name) for name in ("visible", "paper")}
    settings["visible without contrast"] = LabelSettings(selection="visible", min_contrast=None)
    result = {}
    for name, chosen in settings.items():
        split = load_split(dataset, split_name, chosen)
        none = Detections(np.empty((0, 4)), np.empty(0))
        found = [detections.get(frame, none) for frame in split.frames.table["frame_id"]]
        height, width = split.frames.images.shape[1:]
        matches = match_split(found, split.labels, (width, height), 0.5, split.radius_px)
        result[name] = {"labels": len(matches.selected_frame), **figures(matches, threshold)}
    return result


def draw(dataset: Dataset, frame_id: str, path: Path) -> None:
    """Draw the top left part of a frame, plain and with the labels of `visible` without its contrast threshold."""
    frames = dataset.table("frames", ["frame_id", "png_path"]).to_pandas().set_index("frame_id")
    grey = cv2.imread(str(dataset.file(frames.loc[frame_id, "png_path"])), cv2.IMREAD_GRAYSCALE)[:176, :176]
    large = cv2.resize(grey, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_CUBIC)
    plain = cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)
    drawn = plain.copy()
    labels = read_labels(dataset, _ELLIPSE)
    labels = labels[labels["frame_id"] == frame_id]
    chosen = labels[selected(labels, SELECTIONS["visible"].model_copy(update={"min_contrast": None}))]
    for contrast, (cx, cy, a, b, theta) in zip(chosen["contrast"], chosen[_ELLIPSE].to_numpy(), strict=True):
        colour = next(colour for below, colour in _COLOURS if contrast < below)
        box = ((cx * _SCALE, cy * _SCALE), (2 * a * _SCALE, 2 * b * _SCALE), np.degrees(theta))
        cv2.ellipse(drawn, box, colour, 1, cv2.LINE_AA)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.hstack([plain, drawn]), [cv2.IMWRITE_JPEG_QUALITY, 85])


def main(
    dataset: Path,
    run: Path,
    split: Annotated[str, typer.Option(help="val, or test for a report.")] = "val",
    picture: Annotated[str, typer.Option(help="frame_id to draw.")] = "",
    out: Path = Path("runs/bench"),
) -> None:
    """Compare the labels' contrast with the craters that a detector found."""
    opened = open_dataset(dataset)
    config, threshold = config_of_run(run), chosen_threshold(run)
    frames = load_split(opened, split, config.labels)
    found, _ = detect_split(open_run(run, config), frames, split)
    detections = dict(zip(frames.frames.table["frame_id"], found, strict=True))
    result = {
        **measure(opened, detections, threshold, split),
        "metrics": evaluate(opened, detections, threshold, split),
    }
    result["split"] = split
    write_figures(out / "contrast.json", result)
    if picture:
        draw(opened, picture, out / "contrast.jpg")


if __name__ == "__main__":
    run_command_line(one_command(main))
