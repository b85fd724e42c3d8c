"""The installed detector over another generator's ground, with labels of the listed rims and of the measured ones."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from perilune_shared.dataset.manifest import open_single
from perilune_shared.labels.selection import read_labels
from perilune_train.detect.benchmark.score import MATCH_IOU, SCORING_RULES, SEED, SELECTIONS
from perilune_train.detect.config import LabelSettings
from perilune_train.detect.data.frame_facts import facts_of, joined_facts
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.evaluate.evaluation import Evaluation, evaluate_detections
from perilune_train.detect.evaluate.matching import EDGE, Criteria, Detections
from perilune_train.detect.evaluate.pictures import draw_frames
from perilune_train.detect.finished_run import chosen_threshold, config_of_run
from perilune_train.detect.inference.detector import open_run
from perilune_train.detect.inference.scales import detect_split
from perilune_train.records.metrics_file import Metrics
from perilune_train.shipped.models import shipped_run

RIMS = {"listed": "catalogue", "measured": "measured"}
"""Names of two sets of labels, and their `dataset.terrain.elevation.rims`."""
FITTED = "fitted"
"""A third set: the labels of "measured", but craters that keep the listed rim, since the fit failed, are ignored."""
END_ALTITUDE_M = 600.0
"""Altitude of the last frames. Below it the craters that the renderer adds, up to four pixels of the model, would be
labelled too."""
_SETTINGS = {
    "render.engine": "heightfield",
    "detect": "{n_scenes: 1, trajectories_per_scene: 2, n_frames: 12, val_share: 0, test_share: 1}",
    "detect.flight.end_altitude_m": f"{END_ALTITUDE_M:g}",
}
_METRICS = ("ap50_paper", "f1", "precision", "recall", "ap75_paper", "labels")
_ENDS = ("", "_low", "_high")
"""Of a value and of its interval. AP has one by every scoring rule, the others by the usual rule or none."""


def render(folder: Path, name: str) -> None:
    """Render frames over ground.tif of a folder twice, with labels of the craters of list.csv by both sources of rims.

    The ground's name gives the Sun and the flights: Suns and flights of `small`, down to END_ALTITUDE_M.
    """
    program = str(Path(sys.executable).parent / "perilune-render")
    for labels, rims in RIMS.items():
        values = {**_SETTINGS, "name": name, "terrain.elevation.rims": rims}
        settings = [part for key, value in values.items() for part in ("--set", f"dataset.{key}={value}")]
        ground = ["--dem", str(folder / "ground.tif"), "--catalogue", str(folder / "list.csv")]
        command = [program, "dataset", "--kind", "detect", *ground, *settings, "--workers", "0"]
        subprocess.run([*command, "--out", str(folder / labels)], check=True)


def score(folders: dict[str, Path], pictures: Path) -> dict[str, object]:
    """Figures of the installed detector over all grounds by name, and pictures of frames with labels and detections.

    By labels and selection: `listed/visible` and so on. Intervals are over grounds. Labels do not change frames, so
    all sets are scored with the same detections.
    """
    run = shipped_run("detect")
    detector, threshold = open_run(run, config_of_run(run)), chosen_threshold(run)
    found: dict[str, list[Detections]] = {}
    result: dict[str, object] = {}
    for labels in (*RIMS, FITTED):
        for selection in SELECTIONS:
            splits = {name: _load(folder, labels, selection) for name, folder in folders.items()}
            for name, split in splits.items():
                if name not in found:
                    found[name] = detect_split(detector, split, name)[0]
            evaluation = _evaluate(splits, found, threshold)
            result[f"{labels}/{selection}"] = _figures(evaluation)
            images = [image for split in splits.values() for image in split.frames.images]
            draw_frames(evaluation, images, pictures / f"{labels}-{selection}.jpg")
    return {"frames": sum(map(len, found.values())), "threshold": threshold, **result}


def _load(folder: Path, labels: str, selection: str) -> DetectSplit:
    """Frames of one ground and one set of labels."""
    dataset = open_single(folder / ("measured" if labels == FITTED else labels) / "detect")
    split = load_split(dataset, "test", LabelSettings(selection=selection), (1.0, 1 / EDGE))
    if labels != FITTED:
        return split
    craters = dataset.table("craters", ["crater_id", "rim_rms_share"]).to_pandas().dropna()
    rows = read_labels(dataset, split="test")
    fitted = rows["crater_id"].isin(craters["crater_id"]).to_numpy()
    chosen = []
    for frame, own in zip(split.frames.table["frame_id"], split.labels, strict=True):
        keep = own.selected.copy()
        keep[own.labelled] &= fitted[rows["frame_id"] == frame]
        chosen.append(replace(own, selected=keep))
    return replace(split, labels=chosen)


def _evaluate(splits: dict[str, DetectSplit], found: dict[str, list[Detections]], threshold: float) -> Evaluation:
    return evaluate_detections(
        [each for name in splits for each in found[name]],
        [each for split in splits.values() for each in split.labels],
        joined_facts({name: facts_of(split.frames) for name, split in splits.items()}),
        Criteria(threshold, next(iter(splits.values())).radius_px, MATCH_IOU),
        SEED,
    )


def _figures(evaluation: Evaluation) -> Metrics:
    """Figures of one set of labels; the ratios are radii of found craters over radii of their labels."""
    values = evaluation.figures()
    keys = [f"{prefix}{name}{end}" for prefix in SCORING_RULES.values() for name in _METRICS for end in _ENDS]
    overlaps, matches = evaluation.overlaps, evaluation.matches
    own = (matches.label >= 0) & (matches.scores >= evaluation.threshold)
    label = overlaps.label_boxes[matches.label[own]]
    ratio = overlaps.radius_px()[own] / (np.sqrt(np.prod(label[:, 2:] - label[:, :2], axis=1)) / 2)
    p05, median, p95 = map(float, np.percentile(ratio, [5, 50, 95]))
    return {key: values[key] for key in keys if key in values} | {
        "ratio_p05": p05,
        "ratio_median": median,
        "ratio_p95": p95,
    }
