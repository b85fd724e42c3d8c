"""Is a frame like the training frames? Distance of a detector's features from those of its training frames.

The features are means over the frame of the detector's feature maps (`YOLOv3.detect_with_features`). Their distance
from the features of training frames is that of Mahalanobis,

    d^2 = (x - mean)^T covariance^-1 (x - mean)

with the covariance shrunk towards a diagonal matrix (Ledoit and Wolf, 2004, "A well-conditioned estimator for
large-dimensional covariance matrices"), as in Lee et al., 2018, arXiv 1807.03888, with a single class. The novelty of a
frame is d divided by a limit that almost all frames of unseen scenes keep: above 1, the frame is unlike the training.
"""

import base64
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text

Array = NDArray[np.float64]
NOVELTY_FILE = "novelty.json"
"""File of the statistics in the folder of a run."""
MAX_SHARE = 0.01
"""Largest share of frames of unseen scenes above the limit."""
MIN_FRAMES = 8
"""Smallest number of training frames of a fit."""
_FOLDS = 6
_MAX_BYTES = 10_000_000
_EXPECTED = "written by `perilune-train detect calibrate`"

NO_ALARM = (
    "no alarm for images unlike the training: the run has no features of its training frames; `perilune-train detect "
    "calibrate` adds them"
)
"""Message for a detector without training features."""


@dataclass(frozen=True)
class TrainingFeatures:
    """Mean and spread of the features of training frames, and the limit of their distance."""

    mean: Array
    """Mean of each feature (F,)."""
    whitening: NDArray[np.float16]
    """Upper triangular matrix W (F, F): W (x - mean) has uncorrelated elements of variance 1."""
    limit: float
    """Largest distance of a familiar frame."""
    n_frames: int
    """Number of training frames of the fit."""

    def distance(self, features: NDArray[Any]) -> Array:
        """Distances (N,) of features (N, F)."""
        return np.asarray(np.linalg.norm((features - self.mean) @ self.whitening.astype(np.float64).T, axis=1))

    def novelty(self, features: NDArray[Any]) -> Array:
        """Distances (N,) of features (N, F), divided by the limit."""
        return self.distance(features) / self.limit

    def entries(self) -> dict[str, float | int | str | None]:
        """Entries of metrics.json."""
        return {"novelty/frames": self.n_frames, "novelty/limit": self.limit, "novelty/features": len(self.mean)}


def is_novel(novelty: float | None) -> bool:
    """Whether a frame is unlike the training frames; False if unknown (None or NaN)."""
    return novelty is not None and novelty > 1


def novelty_text(novelty: float | None) -> str:
    """Reason of the alarm, in one line."""
    return (
        f"unlike the detector's training frames: novelty: got {novelty:.2f}, expected at most 1; craters are unreliable"
    )


def fit_training_features(plain: Array, changed: Array, scenes: NDArray[Any]) -> TrainingFeatures | None:
    """Fit the features (N, F) of training frames and of augmented copies; `scenes` (N,) are the frames' scenes.

    The limit comes from scenes that were left out of the fit: at most MAX_SHARE of their plain frames are beyond it.
    Returns None with fewer than MIN_FRAMES frames or with a single scene.
    """
    names = np.unique(scenes)
    if len(plain) < MIN_FRAMES or len(names) < 2:
        return None
    distances = np.zeros(len(plain))
    for fold in range(min(_FOLDS, len(names))):
        left_out = np.isin(scenes, names[fold :: min(_FOLDS, len(names))])
        mean, whitening = _gaussian(np.concatenate([plain[~left_out], changed[~left_out]]))
        distances[left_out] = np.linalg.norm((plain[left_out] - mean) @ whitening.T, axis=1)
    mean, whitening = _gaussian(np.concatenate([plain, changed]))
    # The smallest distance that at most MAX_SHARE of the frames exceed.
    limit = np.sort(distances)[::-1][int(MAX_SHARE * len(distances))]
    return TrainingFeatures(mean, whitening.astype(np.float16), float(limit), len(plain))


def _gaussian(features: Array) -> tuple[Array, Array]:
    """Mean (F,), and whitening matrix (F, F) of the shrunk covariance, of features (N, F)."""
    mean, deviation = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-6)
    standard = (features - mean) / deviation
    covariance = shrunk_covariance(standard)
    return mean, np.linalg.cholesky(np.linalg.inv(covariance)).T / deviation


def shrunk_covariance(features: Array) -> Array:
    """Covariance (F, F) of features (N, F) with mean 0, shrunk by the share of Ledoit and Wolf (2004)."""
    n, size = features.shape
    sample = features.T @ features / n
    target = np.trace(sample) / size * np.eye(size)
    spread = ((sample - target) ** 2).sum()
    # Sum over all frames of |x x^T - S|^2 / n^2.
    error = ((features**2).sum(axis=1) ** 2).sum() / n**2 - (sample**2).sum() / n
    share = min(1.0, max(0.0, error / spread)) if spread > 0 else 1.0
    return np.asarray((1 - share) * sample + share * target)


def write_training_features(run: Path, features: TrainingFeatures) -> None:
    """Write novelty.json into the folder of a run; whitening is the upper triangle in half precision, base64."""
    upper = features.whitening[np.triu_indices(len(features.mean))]
    content = {
        "frames": features.n_frames,
        "limit": features.limit,
        "mean": [float(f"{value:.7g}") for value in features.mean],
        "whitening": base64.b64encode(upper.astype("<f2").tobytes()).decode("ascii"),
    }
    write_text(run / NOVELTY_FILE, json.dumps(content) + "\n")


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
        mean = np.array(content["mean"], np.float64)
        upper = np.frombuffer(base64.b64decode(content["whitening"], validate=True), "<f2")
        limit, n_frames = float(content["limit"]), int(content["frames"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise UserError(path, "content", repr(error), _EXPECTED) from None
    if mean.shape != (n_features,) or upper.size != n_features * (n_features + 1) // 2:
        got = f"shape {mean.shape}, whitening of {upper.size} numbers"
        raise UserError(path, "mean", got, f"{n_features} features of the run's network; fit it again")
    if not (np.isfinite(mean).all() and np.isfinite(upper).all() and 0 < limit < math.inf):
        raise UserError(path, "content", "numbers that are not finite, or no positive limit", _EXPECTED)
    whitening = np.zeros((n_features, n_features), np.float16)
    whitening[np.triu_indices(n_features)] = upper
    return TrainingFeatures(mean, whitening, limit, n_frames)
