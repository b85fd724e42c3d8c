"""Evaluate a run on labelled real images; the report has the form of a dataset's report.

Boxes of at least `min_size_px` (sqrt(w h)) that are centred in their image are ground truth. Smaller boxes, boxes
centred off the image and boxes that the label file marks as ignored are ignored. Unmatched detections smaller than
`min_size_px` are ignored too. By default the threshold is the threshold that the run chose on its validation split. The
report also gives the metrics at the best threshold for these images, as an oracle: this threshold cannot be chosen
without labels.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import overload

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.console.terminal import progress_bar
from perilune_shared.errors import UserError
from perilune_shared.export.foreign_text import code_span, for_markdown
from perilune_shared.storage.files import written_aside
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.frame_facts import unknown_facts
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.evaluate.evaluation import Evaluation, evaluate_detections
from perilune_train.detect.evaluate.matching import FALSE, FOUND, Criteria, Detections
from perilune_train.detect.evaluate.metrics import at_threshold, curve
from perilune_train.detect.evaluate.report import write_evaluation
from perilune_train.detect.evaluate.split_evaluation import score_meaning
from perilune_train.detect.finished_run import check_output, chosen_threshold
from perilune_train.detect.images.labelled import ImageSet, LabelledImage, Request, read_images
from perilune_train.detect.images.overlay import draw_boxes, draw_ellipses
from perilune_train.detect.images.predict import table_of
from perilune_train.detect.images.read import read_grey
from perilune_train.detect.inference.detector import Detector, open_run
from perilune_train.detect.inference.tiles import count_tiles, detect_image
from perilune_train.detect.inference.tiling import Tiling, described_by_image
from perilune_train.records.metrics_file import Metrics, write_metrics
from perilune_train.records.pictures import save_image

_CROP_PX = 200
_PAIRS_PER_ROW, _MAX_PAIRS = 3, 12
_LABEL, _SMALL = (64, 64, 255), (48, 192, 224)
_COLOURS = {FOUND: (224, 211, 25), FALSE: (255, 64, 255)}


@dataclass(frozen=True)
class ImageSettings:
    """How to read and evaluate labelled images."""

    tiling: Tiling
    """How to cut images into tiles."""
    min_size_px: float = 8.0
    """Minimum size of a crater to find, sqrt(w h), pixels."""
    threshold: float | None = None
    """Score threshold; None for the threshold of the run."""
    nodata: float | None = None
    """Value of pixels without data."""
    request: Request = field(default_factory=Request)
    """What to read of the source."""


class _Pictures(Sequence[NDArray[np.uint8]]):
    """Pictures that are read only when needed, because they may not all fit into memory."""

    def __init__(self, images: Sequence[LabelledImage], nodata: float | None):
        self._images, self._nodata, self._reported = images, nodata, set[int]()

    def __len__(self) -> int:
        return len(self._images)

    @overload
    def __getitem__(self, index: int) -> NDArray[np.uint8]: ...
    @overload
    def __getitem__(self, index: slice) -> list[NDArray[np.uint8]]: ...
    def __getitem__(self, index: int | slice) -> NDArray[np.uint8] | list[NDArray[np.uint8]]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        # Report the missing data of a picture only when it is read for the first time.
        quiet = index in self._reported
        self._reported.add(index)
        return read_grey(self._images[index].path, self._nodata, quiet)

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        return (self[k] for k in range(len(self)))


def evaluate_images(run: Path, config: DetectConfig, source: Path, out: Path, settings: ImageSettings) -> Metrics:
    """Evaluate a run on labelled images (labelled.py); returns the metrics written to `out`/metrics.json.

    Also writes report.md, detections.parquet, precision_recall.png, reliability.png, bins.png, detections.png and
    crops.png into `out`.
    Raises UserError if any input cannot be read; then nothing is written.
    """
    check_output(out, run)
    tiling, min_size_px, threshold = settings.tiling, settings.min_size_px, settings.threshold
    tiling.check()
    if not 0 < min_size_px < np.inf:
        raise UserError("--min-size", "", min_size_px, "above 0")
    image_set = read_images(source, settings.request)
    if not any(image.selected(min_size_px).any() for image in image_set.images):
        raise UserError(source, "boxes", f"none of {min_size_px:g} px or more", "at least one")
    threshold_source = (
        "of the run, chosen on its validation split" if threshold is None else "given on the command line"
    )
    threshold = chosen_threshold(run) if threshold is None else threshold
    images = _Pictures(image_set.images, settings.nodata)
    # Read all images once, so that a damaged image is refused before hours of detection.
    for _ in images:
        pass
    detector = open_run(run, config)
    detections = _detect(detector, image_set, images, tiling)
    evaluation = evaluate_detections_in_images(
        image_set, detections, threshold, min_size_px, config.evaluation.match_iou
    )
    best = curve(evaluation.matches).best_threshold()
    oracle = dict(zip(("precision", "recall", "f1"), at_threshold(evaluation.matches, best), strict=True))
    scales = [tiling.scales_of(image.height_px, image.width_px) for image in image_set.images]
    about = [
        f"run {code_span(run.resolve().name)}, best weights; {len(images)} images of {code_span(source.name)}",
        f"labels: boxes of {min_size_px:g} px or more (sqrt(w h)), centred in the image",
        f"tiles of {tiling.tile_px} px, overlap {tiling.overlap_px} px, at scale {described_by_image(scales)}"
        + ("" if tiling.box_margin_px == 0 else f"; boxes enlarged by {tiling.box_margin_px:g} px at every side"),
        f"threshold {threshold_source}",
        score_meaning(detector.calibration),
        f"oracle: with the threshold of highest F1 on these images ({best:.4f}), which cannot be known without labels: "
        + ", ".join(f"{name} {value:.3f}" for name, value in oracle.items()),
    ]
    about += [for_markdown(text) for text in (image_set.split, image_set.categories) if text]
    write_evaluation(out, evaluation, images, about)
    table = pd.concat(table_of(image.name, part) for image, part in zip(image_set.images, detections, strict=True))
    with written_aside(out / "detections.parquet") as aside:
        table.to_parquet(aside, index=False)
    write_crops(out / "crops.png", images, evaluation)
    figures: Metrics = {"images/name": source.resolve().name, "images/categories": image_set.categories}
    figures |= {"images/split": image_set.split} | evaluation.figures()
    figures |= {f"oracle/{name}": value for name, value in oracle.items()}
    figures |= {"oracle/threshold": best, "min_size_px": min_size_px, "tile_px": tiling.tile_px}
    figures |= {
        "overlap_px": tiling.overlap_px,
        "box_margin_px": tiling.box_margin_px,
        "scales": "; ".join(" ".join(map(str, each)) for each in dict.fromkeys(scales)),
    }
    write_metrics(out, figures)
    return figures


def frame_labels(image: LabelledImage, min_size_px: float) -> FrameLabels:
    """Convert an image's boxes to labels; the ellipse of a label is inscribed in its box."""
    centre, half = (image.boxes[:, :2] + image.boxes[:, 2:]) / 2, (image.boxes[:, 2:] - image.boxes[:, :2]) / 2
    ellipses = np.column_stack([centre, half, np.zeros(len(half))])
    every = np.ones(len(half), bool)
    selected = image.selected(min_size_px)
    return FrameLabels(image.boxes, image.sizes_px / 2, ellipses, selected, every, crowd=image.crowd)


def evaluate_detections_in_images(
    image_set: ImageSet, detections: list[Detections], threshold: float, min_size_px: float, match_iou: float = 0.5
) -> Evaluation:
    """Evaluate the detections of all images; clips detections at the image edge if the labels are clipped."""
    sizes = np.array([[image.width_px, image.height_px] for image in image_set.images])
    if image_set.clipped:
        limits = np.tile(sizes, 2).astype(np.float64)
        detections = [
            replace(part, boxes=np.clip(part.boxes, 0, limit)) for part, limit in zip(detections, limits, strict=True)
        ]
    return evaluate_detections(
        detections,
        [frame_labels(image, min_size_px) for image in image_set.images],
        unknown_facts([image.name for image in image_set.images], sizes),
        Criteria(threshold, (min_size_px / 2, np.inf), match_iou),
    )


def _detect(detector: Detector, image_set: ImageSet, images: _Pictures, tiling: Tiling) -> list[Detections]:
    detections = []
    with progress_bar() as progress:
        total = sum(count_tiles(image.height_px, image.width_px, tiling) for image in image_set.images)
        bar = progress.add_task("detect", total=total, unit="tiles", note="")
        for image in images:
            detections.append(detect_image(detector, image, tiling, lambda n: progress.advance(bar, n)))
    return detections


def write_crops(path: Path, images: Sequence[NDArray[np.uint8]], evaluation: Evaluation) -> None:
    """Draw the centres of at most 12 images, enlarged twice, with labels and detections side by side.

    Left: labels (selected labels red, others orange). Right: detections above the threshold (matched detections cyan,
    false positives magenta, ignored detections omitted).
    """
    chosen = np.unique(np.linspace(0, len(images) - 1, min(len(images), _MAX_PAIRS)).round().astype(int))
    pairs = [_crop_pair(images[index], evaluation, int(index)) for index in chosen]
    pairs += [np.zeros_like(pairs[0])] * (-len(pairs) % min(_PAIRS_PER_ROW, len(pairs)))
    columns = min(_PAIRS_PER_ROW, len(pairs))
    rows = [np.concatenate(pairs[k : k + columns], axis=1) for k in range(0, len(pairs), columns)]
    save_image(path, np.concatenate(rows))


def _crop_pair(image: NDArray[np.uint8], evaluation: Evaluation, index: int) -> NDArray[np.uint8]:
    corner = np.maximum((np.array(image.shape) - _CROP_PX) // 2, 0)
    crop = image[corner[0] :, corner[1] :][:_CROP_PX, :_CROP_PX]
    square = np.zeros((_CROP_PX, _CROP_PX), np.uint8)
    square[: crop.shape[0], : crop.shape[1]] = crop
    large = cv2.cvtColor(cv2.resize(square, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), cv2.COLOR_GRAY2BGR)
    left, right = np.array(large, np.uint8), np.array(large, np.uint8)
    shift = np.tile(corner[::-1], 2)
    truth, matches = evaluation.labels[index], evaluation.matches
    draw_boxes(left, 2 * (truth.boxes[~truth.selected] - shift), _SMALL)
    draw_boxes(left, 2 * (truth.boxes[truth.selected] - shift), _LABEL)
    strong = (matches.frame == index) & (matches.scores >= evaluation.threshold)
    for outcome, colour in _COLOURS.items():
        ellipses = evaluation.overlaps.ellipses[strong & (matches.outcome == outcome)]
        draw_ellipses(right, (ellipses - [*corner[::-1], 0, 0, 0]) * [2, 2, 2, 2, 1], colour)
    pair = np.concatenate([left, right], axis=1)
    pair[[0, -1]] = pair[:, [0, -1]] = 255
    cv2.putText(pair, evaluation.facts.name[index][:40], (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1)
    return pair
