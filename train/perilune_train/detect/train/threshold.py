"""Choose the score threshold of a detector on validation frames.

Optionally also uses copies of the frames with other contrast, blur and noise.
"""

from dataclasses import replace

import numpy as np

from perilune_train.detect.config import AugmentSettings
from perilune_train.detect.data.augment import augment
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.evaluate.matching import Detections, match_split
from perilune_train.detect.evaluate.metrics import curve
from perilune_train.detect.inference.detector import Detector
from perilune_train.detect.inference.scales import detect_split

VARIED = AugmentSettings(flips_and_turns=False, gain=0.3, gamma=0.6, stretch=0.1, blur_px=0.6, noise=5.0)
"""Variation of the copies of validation frames; it is wider than in training, to cover published images."""
_STREAM = 7


def threshold_on_validation(
    detector: Detector, split: DetectSplit, plain_detections: list[Detections]
) -> tuple[float, str]:
    """Choose the threshold by the rule in `detect.evaluation`; return the threshold and a description.

    With `detect.evaluation.varied_frames`, each frame counts twice: unchanged and varied.
    """
    config = detector.config
    labels, detections, frames = list(split.labels), list(plain_detections), "val"
    if config.evaluation.varied_frames:
        varied, _ = detect_split(detector, varied_split(split, config.seed), "varied val")
        labels, detections, frames = labels * 2, detections + varied, "val and varied val"
    height, width = split.frames.images.shape[1:]
    matches = match_split(detections, labels, (width, height), config.evaluation.match_iou, split.radius_px)
    threshold, rule = curve(matches).operating_threshold(config.evaluation.min_precision)
    return threshold, f"{rule} on {frames}"


def varied_split(split: DetectSplit, seed: int) -> DetectSplit:
    """Copies of the frames with other contrast, blur and noise (`VARIED`), and unchanged labels."""
    images = np.empty_like(split.frames.images)
    for number, image in enumerate(split.frames.images):
        frame_labels = split.labels[number]
        rng = np.random.default_rng([seed, _STREAM, number])
        pixels, _, _ = augment(image, frame_labels.outlines, frame_labels.selected, split.radius_px, VARIED, rng)
        images[number] = np.clip(np.rint(pixels), 0, 255).astype(np.uint8)
    return replace(split, frames=replace(split.frames, images=images))
