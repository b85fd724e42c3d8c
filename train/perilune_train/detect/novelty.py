"""Is a frame like the training frames? Distance of a detector's features from those of its training frames.

The features are means over the frame of maps of the network (`YOLOv3.detect_with_features`). Their distance is that of
Mahalanobis for one class (Lee et al., 2018, arXiv 1807.03888). The covariance has the largest principal components of
the training frames, and one variance for the directions that remain (Tipping and Bishop, 1999, "Probabilistic Principal
Component Analysis"), because there are more features than frames can determine. The novelty of a frame is its distance
divided by a limit that 99 % of the frames of left-out training scenes keep: above 1, the frame is unlike the training.
"""

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text
from perilune_train.records.metrics_file import Metrics

Array = NDArray[np.float64]
NOVELTY_FILE = "novelty.json"
"""File of the training features in the folder of a run."""
MAX_SHARE = 0.01
"""Largest share of frames of left-out training scenes beyond the limit."""
MIN_FRAMES = 8
"""Smallest number of training frames of a fit."""
_COMPONENTS, _FRAMES_EACH = 32, 4
"""Largest number of principal components, and smallest number of frames for each of them."""
_FOLDS = 6
_MAX_BYTES, _MAX_COMPONENTS = 10_000_000, 1000
_EXPECTED = "a file that `perilune-train detect calibrate` wrote"
NO_ALARM = (
    "no alarm for images unlike the training: the run has no features of its training frames; `perilune-train detect "
    "calibrate` adds them"
)
"""Message for a detector without training features."""


@dataclass(frozen=True)
class Gaussian:
    """Distribution of features: principal components, and one variance for all other directions."""

    mean: Array
    """Mean of each feature (F,)."""
    deviation: Array
    """Standard deviation of each feature (F,). All following values are in these units."""
    directions: Array
    """Unit vectors of the principal components (K, F)."""
    variances: Array
    """Variances of the principal components (K,)."""
    other_variance: float
    """Variance of every other direction."""

    def distance(self, features: Array) -> Array:
        """Mahalanobis distances (N,) of features (N, F)."""
        standard = (features - self.mean) / self.deviation
        parts = (standard @ self.directions.T) ** 2
        rest = np.maximum((standard**2).sum(axis=1) - parts.sum(axis=1), 0)
        return np.asarray(np.sqrt((parts / self.variances).sum(axis=1) + rest / self.other_variance))


@dataclass(frozen=True)
class TrainingFeatures:
    """Distribution of the features of training frames, and the limit of the distance from it."""

    gaussian: Gaussian
    """Distribution of the features."""
    limit: float
    """Largest distance of a familiar frame."""
    n_frames: int
    """Number of training frames of the fit."""

    def novelty(self, features: Array) -> Array:
        """Distances (N,) of features (N, F), divided by the limit."""
        return self.gaussian.distance(features) / self.limit


def is_novel(novelty: float | None) -> bool:
    """Whether a frame is unlike the training frames; False if unknown (None or NaN)."""
    return novelty is not None and novelty > 1


def novelty_text(novelty: float | None) -> str:
    """Reason of the alarm, in one line."""
    return f"novelty: got {novelty:.2f}, expected at most 1: unlike the detector's training, so craters are unreliable"


def fit_training_features(features: Array, scenes: NDArray[Any]) -> TrainingFeatures | None:
    """Fit the features (N, F) of training frames; `scenes` (N,) are the frames' scenes.

    The limit comes from scenes that were left out of a fit: at most MAX_SHARE of their frames are beyond it. Returns
    None with fewer than MIN_FRAMES frames or with a single scene.
    """
    names = np.unique(scenes)
    folds = min(_FOLDS, len(names))
    if len(features) < MIN_FRAMES or folds < 2:
        return None
    distances = np.zeros(len(features))
    for fold in range(folds):
        left_out = np.isin(scenes, names[fold::folds])
        distances[left_out] = fit_gaussian(features[~left_out]).distance(features[left_out])
    limit = np.sort(distances)[::-1][int(MAX_SHARE * len(distances))]
    return TrainingFeatures(fit_gaussian(features), float(limit), len(features))


def fit_gaussian(features: Array) -> Gaussian:
    """Fit the distribution of features (N, F)."""
    n_frames, n_features = features.shape
    mean = features.mean(axis=0)
    # Constant features carry no information, and must not divide by 0.
    deviation = np.maximum(features.std(axis=0), 1e-6 + 1e-3 * np.abs(mean))
    standard = (features - mean) / deviation
    variances, directions = np.linalg.eigh(standard.T @ standard / n_frames)
    variances, directions = np.maximum(variances[::-1], 1e-6), directions[:, ::-1].T
    count = max(1, min(_COMPONENTS, n_frames // _FRAMES_EACH, n_features - 1))
    # Single precision, as in the file, so that a stored fit is exactly the fit.
    kept = directions[:count].astype(np.float32).astype(np.float64)
    return Gaussian(mean, deviation, kept, variances[:count], float(variances[count:].mean()))


def write_training_features(run: Path, features: TrainingFeatures | None) -> Metrics:
    """Write novelty.json into the folder of a run, or remove it without features; returns the entries of metrics.json.

    The directions are float32 numbers in base64.
    """
    if features is None:
        (run / NOVELTY_FILE).unlink(missing_ok=True)
        return {"novelty": f"none: fewer than {MIN_FRAMES} training frames, or a single scene"}
    gaussian = features.gaussian
    content = {
        "frames": features.n_frames,
        "limit": features.limit,
        "mean": gaussian.mean.tolist(),
        "deviation": gaussian.deviation.tolist(),
        "variances": gaussian.variances.tolist(),
        "other_variance": gaussian.other_variance,
        "directions": base64.b64encode(gaussian.directions.astype("<f4").tobytes()).decode("ascii"),
    }
    write_text(run / NOVELTY_FILE, json.dumps(content) + "\n")
    return {"novelty/frames": features.n_frames, "novelty/limit": features.limit}


def read_training_features(run: Path, n_features: int) -> TrainingFeatures | None:
    """Read novelty.json of a run whose network has `n_features` features; None if there is no such file.

    Raises UserError if the file is damaged or belongs to another network.
    """
    path = run / NOVELTY_FILE
    if not path.is_file():
        return None
    if path.stat().st_size > _MAX_BYTES:
        raise UserError(path, "size", f"{path.stat().st_size} bytes", f"at most {_MAX_BYTES}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        mean, deviation, variances = (
            np.array(content[key], np.float64).reshape(-1) for key in ("mean", "deviation", "variances")
        )
        directions = np.frombuffer(base64.b64decode(content["directions"], validate=True), "<f4").astype(np.float64)
        other, limit, n_frames = float(content["other_variance"]), float(content["limit"]), int(content["frames"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise UserError(path, "content", repr(error), _EXPECTED) from None
    if len(mean) != n_features or len(deviation) != n_features:
        expected = f"{n_features}, the features of the run's network; `perilune-train detect calibrate` writes the file"
        raise UserError(path, "mean", f"{len(mean)} numbers", expected)
    if not 1 <= len(variances) <= _MAX_COMPONENTS or directions.size != len(variances) * n_features:
        raise UserError(path, "directions", f"{directions.size} numbers", f"{len(variances)} x {n_features}")
    numbers = np.concatenate([mean, deviation, variances, directions, [other, limit]])
    positive = np.concatenate([deviation, variances, [other, limit]])
    if not np.isfinite(numbers).all() or positive.min() <= 0:
        raise UserError(path, "content", "numbers that are not finite or not positive", _EXPECTED)
    gaussian = Gaussian(mean, deviation, directions.reshape(len(variances), n_features), variances, other)
    return TrainingFeatures(gaussian, limit, n_frames)
