"""Choose the score threshold of a detector, and fit the calibration of its scores, on validation frames.

Optionally also uses copies of the frames with other contrast, blur and noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from perilune_train.detect.calibration import fit_calibration
from perilune_train.detect.config import AugmentSettings, EvaluationSettings
from perilune_train.detect.data.augment import augment
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.evaluate.matching import Detections, Overlaps, find_overlaps
from perilune_train.detect.evaluate.metrics import curve
from perilune_train.detect.evaluate.reliability import ScoredMatches, decided_matches, expected_calibration_error
from perilune_train.detect.inference.detector import Detector
from perilune_train.detect.inference.scales import detect_split
from perilune_train.records.metrics_file import Metrics

VARIED = AugmentSettings(flips_and_turns=False, gain=0.3, gamma=0.6, stretch=0.1, blur_px=0.6, noise=5.0)
"""Variation of the copies of validation frames; it is wider than in training, to cover published images."""
_STREAM = 7


@dataclass(frozen=True)
class ValidationDetections:
    """Detections in validation frames and, with `detect.evaluation.varied_frames`, in varied copies of the frames."""

    detections: list[Detections]
    """Detections, one entry per frame."""
    labels: Sequence[FrameLabels]
    """Labels, one entry per frame."""
    size_px: tuple[int, int]
    """Width and height of the frames."""
    radius_px: tuple[float, float]
    """Range of the evaluated radii, pixels."""
    frames: str
    """Name of the frames, for reports."""

    def threshold(self, settings: EvaluationSettings) -> tuple[float, str]:
        """Choose the threshold by the rule in `detect.evaluation`; return the threshold and a description."""
        matches = self._overlaps(settings).match(settings.match_iou, self.radius_px)
        threshold, rule = curve(matches).operating_threshold(settings.min_precision)
        return threshold, f"{rule} on {self.frames}"

    def decided_matches(self, settings: EvaluationSettings) -> ScoredMatches:
        """The detections that the labels can decide (`reliability.decided_matches`)."""
        overlaps = self._overlaps(settings)
        return decided_matches(overlaps, overlaps.match(settings.match_iou, self.radius_px), self.radius_px)

    def _overlaps(self, settings: EvaluationSettings) -> Overlaps:
        sizes = np.tile(self.size_px, (len(self.detections), 1))
        return find_overlaps(self.detections, self.labels, sizes, settings.match_iou)


def detect_validation(
    detector: Detector, split: DetectSplit, plain_detections: list[Detections] | None = None
) -> ValidationDetections:
    """Detect in the validation frames, unless `plain_detections` has their detections, and in varied copies.

    With `detect.evaluation.varied_frames`, each frame counts twice: unchanged and varied.
    """
    plain = detect_split(detector, split, "val")[0] if plain_detections is None else plain_detections
    labels, detections, frames = list(split.labels), list(plain), "val"
    if detector.config.evaluation.varied_frames:
        varied, _ = detect_split(detector, varied_split(split, detector.config.seed), "varied val")
        labels, detections, frames = labels * 2, detections + varied, "val and varied val"
    height, width = split.frames.images.shape[1:]
    return ValidationDetections(detections, labels, (width, height), split.radius_px, frames)


def threshold_on_validation(
    detector: Detector, split: DetectSplit, plain_detections: list[Detections]
) -> tuple[float, str]:
    """Choose the threshold by the rule in `detect.evaluation`; return the threshold and a description."""
    return detect_validation(detector, split, plain_detections).threshold(detector.config.evaluation)


def calibration_entries(found: ValidationDetections, settings: EvaluationSettings, raw_threshold: float) -> Metrics:
    """Fit the calibration to detections with the network's scores; return its entries of metrics.json.

    `raw_threshold` is the threshold of these scores. Without enough detections (`fit_calibration`), the only entry says
    so.
    """
    decided = found.decided_matches(settings)
    calibration = fit_calibration(decided.scores, decided.matched)
    if calibration is None:
        return {"calibration": "none: too few detections, or scores without information"}
    after = ScoredMatches(calibration.probabilities(decided.scores), decided.matched)
    return {
        "calibration": "beta",
        "calibration/log_score": calibration.log_score,
        "calibration/log_complement": calibration.log_complement,
        "calibration/offset": calibration.offset,
        "calibration/raw_threshold": raw_threshold,
        "calibration/threshold": calibration.probability(raw_threshold),
        "calibration/frames": found.frames,
        "calibration/detections": len(decided.scores),
        "calibration/ece_before": expected_calibration_error(decided),
        "calibration/ece_after": expected_calibration_error(after),
    }


def varied_split(split: DetectSplit, seed: int) -> DetectSplit:
    """Copies of the frames with other contrast, blur and noise (`VARIED`), and unchanged labels."""
    images = np.empty_like(split.frames.images)
    for number, image in enumerate(split.frames.images):
        frame_labels = split.labels[number]
        rng = np.random.default_rng([seed, _STREAM, number])
        pixels, _, _ = augment(image, frame_labels.outlines, frame_labels.selected, split.radius_px, VARIED, rng)
        images[number] = np.clip(np.rint(pixels), 0, 255).astype(np.uint8)
    return replace(split, frames=replace(split.frames, images=images))
