"""Performance of a network on single images, compared before and after an intervention."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.evaluate.matching import match_split
from perilune_train.detect.evaluate.metrics import curve
from perilune_train.detect.inference.detector import Detector
from perilune_train.detect.inference.suppression import detections_of
from perilune_train.explain.maps.masks import stacked_input
from perilune_train.models.navigator import StackNavigator

Values = NDArray[np.float64]
_BATCH = 8


@dataclass(frozen=True)
class DetectionPerformance:
    """Function from images (N, height, width) to a detector's average precision on each image.

    The images show N labelled frames, unchanged or after an intervention.
    """

    detector: Detector
    """The detector, at scale 1 only, because an attention mask belongs to one scale."""
    labels: Sequence[FrameLabels]
    """Labels of the N frames."""
    radius_px: tuple[float, float]
    """Smallest and largest crater radius that is evaluated, pixels."""

    def __call__(self, images: NDArray[np.uint8]) -> Values:
        """AP (N,) of each frame by the paper's definition, from images (N, height, width).

        NaN for frames without selected labels.
        """
        detections = []
        for start in range(0, len(images), _BATCH):
            boxes, scores, _ = self.detector.predict(images[start : start + _BATCH])
            detections += detections_of(boxes, scores, self.detector.config.evaluation)
        size = images.shape[2], images.shape[1]
        match_iou = self.detector.config.evaluation.match_iou
        values = [
            curve(match_split([frame_detections], [labels], size, match_iou, self.radius_px)).ap_paper()
            if labels.selected.any()
            else np.nan
            for frame_detections, labels in zip(detections, self.labels, strict=True)
        ]
        return np.array(values)


@dataclass(frozen=True)
class MotionPerformance:
    """Function from images of stacked frame pairs to a stack navigator's position error on each pair.

    A run is a sequence of consecutive pairs. Each run starts from the initial state of the LSTM.
    """

    navigator: StackNavigator
    """The network, in evaluation mode."""
    truth_m: Values
    """Truth of the network's first three outputs (runs, pairs, 3), metres: for a network that estimates motion, the
    translation in O_C of the earlier frame; for a network that estimates the pose, the position in O_L."""
    mean_m: Values
    """Mean of the truth over the training set (3,), metres."""
    spread_m: Values
    """Standard deviation of the truth over the training set (3,), metres."""
    size_px: int
    """Width of the network's input, pixels."""

    def __call__(self, images: NDArray[np.uint8]) -> Values:
        """Position errors (n,), metres, of the n = runs * pairs stacked pairs (n, 2 height, width)."""
        runs, pairs = self.truth_m.shape[:2]
        first, second = stacked_input(images, self.size_px)
        device = next(self.navigator.parameters()).device
        halves = [torch.from_numpy(half).unflatten(0, (runs, pairs)).to(device) for half in (first, second)]
        with torch.no_grad():
            output = torch.cat([self.navigator(*(half[k : k + 1] for half in halves))[0] for k in range(runs)])
        estimated = self.mean_m + self.spread_m * output[..., :3].double().cpu().numpy()
        return np.linalg.norm(estimated - self.truth_m, axis=-1).ravel()
