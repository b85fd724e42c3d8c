"""Load a trained detector, and run its network on a device."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from perilune_shared.errors import UserError
from perilune_shared.threads import warn_if_crowded
from perilune_train.data.frames import normalised
from perilune_train.detect.calibration import Calibration
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.batches import network_input
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.finished_run import calibration_of
from perilune_train.detect.novelty import TrainingFeatures, read_training_features
from perilune_train.models.architecture import DetectorArchitecture, check_architecture_of, without_memory
from perilune_train.models.yolo import YOLOv3
from perilune_train.training import runs
from perilune_train.training.fair_threads import FairThreads


@dataclass(frozen=True)
class Detector:
    """A trained network, and the settings to run it with."""

    network: YOLOv3
    """The network, in evaluation mode, on the device."""
    config: DetectConfig
    """The run's settings."""
    device: str
    """cpu or cuda."""
    bf16: bool
    """Whether the network computes in bfloat16."""
    threads: FairThreads = field(default_factory=FairThreads)
    """Number of threads on a CPU, adapted to other work on the machine."""
    calibration: Calibration | None = None
    """Map from the network's scores to probabilities; None leaves the scores as they are."""
    training_features: TrainingFeatures | None = None
    """Features of the training frames, from which the novelty of a frame is computed; None if the run has none."""

    def predict(self, images: NDArray[np.uint8]) -> tuple[Tensor, Tensor, Tensor | None]:
        """Boxes (N, K, 4), scores (N, K) and shapes (N, K, 5) of all predictors, for images (N, height, width).

        Boxes and shapes are in pixels, as from `YOLOv3.detect_ellipses`.
        """
        return self._run(self.network.detect_ellipses, images)

    def predict_with_novelty(
        self, images: NDArray[np.uint8]
    ) -> tuple[Tensor, Tensor, Tensor | None, list[float] | None]:
        """The result of `predict`, and the novelty of each image; None if the run has no features of training frames.

        Both come from the same forward pass.
        """
        if self.training_features is None:
            return *self.predict(images), None
        boxes, scores, shapes, features = self._run(self.network.detect_with_features, images)
        return boxes, scores, shapes, self.training_features.novelty(features.double().cpu().numpy()).tolist()

    def features(self, images: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Features (N, F) of images (N, height, width), as from `YOLOv3.detect_with_features`."""
        size = self.config.batch_size
        batches = [images[start : start + size] for start in range(0, len(images), size)]
        parts = [self._run(self.network.detect_with_features, batch)[3] for batch in batches]
        return torch.cat(parts).double().cpu().numpy()

    @torch.no_grad()
    def _run(self, function: Callable[[Tensor], Any], images: NDArray[np.uint8]) -> Any:
        """Apply a function of the network to images (N, height, width)."""
        inputs = network_input(normalised(images), self.config.in_channels).to(self.device)
        with self.threads, torch.autocast(self.device, torch.bfloat16, enabled=self.bf16):
            return function(inputs)

    def calibrated(self, detections: Detections) -> Detections:
        """The detections, after suppression, with their probabilities as scores."""
        if self.calibration is None:
            return detections
        return replace(detections, scores=self.calibration.probabilities(detections.scores))


def load_detector(path: Path) -> YOLOv3:
    """Load the network of a detect run's best.ckpt, in evaluation mode. Raises UserError on other files."""
    content = runs.load_weights(path)
    check_detector(content, path)
    network = YOLOv3(None, **content["architecture"])
    runs.load_state(network, content["state_dict"], path)
    return network.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


def check_detector(content: Mapping[str, Any], path: Path) -> None:
    """Raise UserError unless a checkpoint contains a detector; the check allocates no memory for weights."""
    architecture = content["architecture"]
    fields = DetectorArchitecture.model_fields
    required = {name for name, setting in fields.items() if setting.is_required()}
    if not required <= set(architecture) <= set(fields):
        raise UserError(path, "architecture", sorted(map(str, architecture)), "a detect run's checkpoint")
    check_architecture_of(DetectorArchitecture, architecture, path)
    runs.check_tensors(path, content["state_dict"], without_memory(lambda: YOLOv3(None, **architecture)))


def open_detector(checkpoint: Path, config: DetectConfig) -> Detector:
    """Load a detect run's best.ckpt onto the device of the settings, without calibration.

    Same errors as `load_detector`. `open_run` also reads the calibration of a finished run.
    """
    device = runs.choose_device(config.device)
    if device == "cpu":
        warn_if_crowded()
    network = load_detector(checkpoint).to(device)
    return Detector(network, config, device, runs.choose_bf16(config.precision, device), FairThreads(device == "cpu"))


def open_run(run: Path, config: DetectConfig) -> Detector:
    """Load the best weights, the calibration and the training features of a finished run.

    `config` is the run's, or a changed copy of it.

    If the run has a calibration, the scores of all detections are probabilities, like its threshold
    (`finished_run.chosen_threshold`). Raises UserError if a file is missing or damaged.
    """
    detector = open_detector(runs.RunFolder(run).best, config)
    n_features = detector.network.n_features
    return replace(detector, calibration=calibration_of(run), training_features=read_training_features(run, n_features))
