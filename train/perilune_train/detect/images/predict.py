"""Detect craters in images of any size: tables, overlays and, for images with a georeference, GeoJSON."""

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from perilune_shared.console.terminal import progress_bar, say
from perilune_shared.errors import UserError
from perilune_shared.export.foreign_text import write_csv
from perilune_shared.storage.files import new_folder
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.evaluate.split_evaluation import ellipse_columns
from perilune_train.detect.finished_run import chosen_threshold
from perilune_train.detect.images.georeference import (
    Georeference,
    can_read_georeferences,
    collection,
    features,
    read_georeference,
)
from perilune_train.detect.images.overlay import write_overlay
from perilune_train.detect.images.pictures import check_names, pictures_of
from perilune_train.detect.images.read import picture_size, read_grey
from perilune_train.detect.images.sequences import frames_of
from perilune_train.detect.images.suspect import Suspicion, suspicion_of
from perilune_train.detect.inference.detector import open_run
from perilune_train.detect.inference.tiles import count_tiles, detect_image
from perilune_train.detect.inference.tiling import Tiling, described_by_image
from perilune_train.detect.novelty import NO_ALARM, is_novel, novelty_text

_SHOWN_DOUBTS = 5


@dataclass(frozen=True)
class PredictSettings:
    """How to find craters in images."""

    tiling: Tiling
    """How to cut images into tiles."""
    threshold: float | None = None
    """Minimum score; None for the threshold of the run."""
    min_size_px: float = 0.0
    """Minimum size of a crater, sqrt(w h), pixels."""
    nodata: float | None = None
    """Value of pixels without data."""
    top: int | None = None
    """Maximum number of craters in an image; the highest scores are kept. None keeps all."""


def predict_images(sources: list[Path], run: Path, config: DetectConfig, out: Path, settings: PredictSettings) -> int:
    """Find craters in images, folders of images, videos and multi-page TIFF files; returns their number.

    Each frame of a video, and each page of a TIFF, is an image with its index in the name (sequences.py). Writes all
    output to the new folder `out`. If an image cannot be read, raises UserError before detection starts, and writes
    nothing.
    """
    settings.tiling.check()
    with tempfile.TemporaryDirectory(prefix="perilune-") as folder:
        return _predict(expanded(sources, Path(folder)), run, config, out, settings)


def _predict(paths: list[Path], run: Path, config: DetectConfig, out: Path, settings: PredictSettings) -> int:
    tiling, nodata = settings.tiling, settings.nodata
    check_names(paths, [path.name for path in paths])
    with new_folder(out) as folder, progress_bar() as progress:
        check = progress.add_task("check", total=len(paths), unit="images", note="")
        references: list[Georeference | None] = []
        scales: list[tuple[float, ...]] = []
        n_tiles = 0
        for path in paths:
            width, height = picture_size(path)
            scales.append(tiling.scales_of(height, width))
            read_grey(path, nodata)
            references.append(_reference(path))
            n_tiles += count_tiles(height, width, tiling)
            progress.advance(check)
        threshold = chosen_threshold(run) if settings.threshold is None else settings.threshold
        detector = open_run(run, config)
        if not detector.network.ellipses:
            say(
                f"{run.name}: this detector predicts only boxes: ellipses are axis-aligned, without standard deviations"
            )
        if detector.calibration is None:
            say("scores are no probabilities: the run has no calibration; `perilune-train detect calibrate` adds one")
        if detector.training_features is None:
            say(NO_ALARM)
        say(f"scales: {described_by_image(scales)}")
        bar = progress.add_task("detect", total=n_tiles, unit="tiles", note="")
        tables, shapes, doubts, novel = [], [], [], []
        for path, reference in zip(paths, references, strict=True):
            progress.update(bar, note=path.name)
            image = read_grey(path, nodata, quiet=True)
            detections = detect_image(detector, image, tiling, lambda n: progress.advance(bar, n))
            suspicion = suspicion_of(image, detections, detector.calibration is not None)
            if suspicion is not None:
                doubts.append(f"warning: {path.name}: {suspicion.text}")
            elif is_novel(detections.novelty):
                novel.append(f"warning: {path.name}: {novelty_text(detections.novelty)}")
            detections = strongest(of_size(above(detections, threshold), settings.min_size_px), settings.top)
            tables.append(flagged(table_of(path.name, detections), suspicion, detections.novelty))
            write_overlay(folder / f"{path.name}.overlay.png", image, detections, threshold)
            if reference is not None:
                located = features(path.name, detections, reference)
                shapes += located
                if len(located) < len(detections.boxes):
                    n_off_map = len(detections.boxes) - len(located)
                    say(f"{path.name}: {n_off_map} craters have no map coordinates and are not in detections.geojson")
        table = pd.concat(tables, ignore_index=True)
        table.to_parquet(folder / "detections.parquet", index=False)
        write_csv(table.round(4), folder / "detections.csv")
        if any(reference is not None for reference in references):
            (folder / "detections.geojson").write_text(json.dumps(collection(shapes)) + "\n", encoding="utf-8")
    for lines, what in ((doubts, "may not show the Moon"), (novel, "are unlike the training frames")):
        for line in lines[:_SHOWN_DOUBTS]:
            say(line)
        if len(lines) > _SHOWN_DOUBTS:
            say(f"warning: {len(lines) - _SHOWN_DOUBTS} more images that {what}")
    return len(table)


def _reference(path: Path) -> Georeference | None:
    if can_read_georeferences():
        try:
            return read_georeference(path)
        except UserError as error:
            # Detection needs no georeference, and many files have a wrong georeference or one of another body.
            message = (
                f"{path.name}: not in detections.geojson, since its georeference cannot be used: {error.field}: got"
            )
            say(f"{message} {error.found}, expected {error.expected}")
            return None
    if path.suffix.lower() in (".tif", ".tiff") or path.with_suffix(".prj").is_file():
        say(f"{path.name}: reading its georeference needs rasterio and pyproj (pip install 'perilune-train[geo]')")
    return None


def above(detections: Detections, threshold: float) -> Detections:
    """The detections with at least this score."""
    return detections.take(detections.scores >= threshold)


def of_size(detections: Detections, min_size_px: float) -> Detections:
    """The detections of at least this size, sqrt(w h), pixels."""
    large = np.sqrt(np.prod(detections.boxes[:, 2:] - detections.boxes[:, :2], axis=1)) >= min_size_px
    return detections.take(large)


def strongest(detections: Detections, top: int | None) -> Detections:
    """The `top` detections with the highest scores, in the given order; all if None."""
    if top is None or len(detections.scores) <= top:
        return detections
    return detections.take(np.sort(np.argsort(-detections.scores, kind="stable")[:top]))


def expanded(sources: list[Path], frames: Path) -> list[Path]:
    """Paths of all images: the sources that are images, the images of folders, and the frames of videos.

    Writes the frames of videos and the pages of TIFF files into the folder `frames`. Raises UserError on a folder
    without images, and on a video that cannot be decoded.
    """
    paths = []
    for path in sources:
        if not path.is_dir():
            paths += frames_of(path, frames) or [path]
            continue
        images = pictures_of(path)
        if not images:
            raise UserError(
                path, "images", "a folder without images", "PNG, TIFF, JPEG or other images, not in subfolders"
            )
        paths += images
    return paths


def table_of(name: str, detections: Detections) -> pd.DataFrame:
    """Detections as table rows: image name, box, centre, radius sqrt(w h) / 2 (all in pixels), score and ellipse.

    The columns of the ellipse are those of `ellipse_columns`; unknown standard deviations are null.
    """
    x0, y0, x1, y1 = detections.boxes.T
    columns: dict[str, Any] = {
        "image": pd.Series([name] * len(detections.scores), dtype="str"),
        "x0_px": x0,
        "y0_px": y0,
        "x1_px": x1,
        "y1_px": y1,
        "centre_x_px": (x0 + x1) / 2,
        "centre_y_px": (y0 + y1) / 2,
        "radius_px": np.sqrt((x1 - x0) * (y1 - y0)) / 2,
        "score": detections.scores,
        **ellipse_columns(detections),
    }
    return pd.DataFrame(columns)


def flagged(table: pd.DataFrame, suspicion: Suspicion | None, novelty: float | None) -> pd.DataFrame:
    """Add `suspect` (the reason of the suspicion, or an empty text) and `novelty` (NaN if unknown) to a table."""
    reason, value = "" if suspicion is None else suspicion.reason, np.nan if novelty is None else novelty
    return table.assign(suspect=pd.Series([reason] * len(table), dtype="str"), novelty=np.full(len(table), value))
