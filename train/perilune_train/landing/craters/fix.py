"""Estimate a camera's pose by matching craters to a catalogue, from a start near the true pose.

Each round projects the catalogue into the image and matches sightings and craters one to one within a gate. It then
takes a Gauss-Newton step that fits the centres and sizes of the ellipses with Tukey's weights (Beaton & Tukey 1974, doi
10.1080/00401706.1974.10489171). The gate narrows from round to round. The ellipse centres are computed exactly, because
the centre of a circle does not project to the centre of its ellipse.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_train.compiled import compiled
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.matching import Circles, matched
from perilune_train.landing.craters.projection import Pose, in_view, projected
from perilune_train.landing.craters.sightings import Sightings

_GATES_PX = (6.0, 3.0, 1.5, 0.0, 0.0, 0.0)
"""Uncertainty of the pose in each round, pixels, in addition to the noise of the sightings."""
_GATE_SIGMAS = 3.5
_FARTHEST_PX, _SMALLER = 64.0, 0.8
"""All rounds leave out craters farther outside the image than this, or smaller than this share of the smallest radius
to match. The start is correct to a few pixels, and the rounds consider craters up to 18 px outside the image."""
_TUKEY = 4.685
COMMON_PX = 0.08
"""Standard deviation, pixels, of the error that all centres in a frame share."""
_LEAST_SIZE = 0.7
"""Radius of the smallest crater to match, as a share of the radius of the smallest sighting."""
_LEAST_MATCHES = 6
_LEAST_SHARE = 0.3
"""Smallest share of the sightings that must be matched; a fix with fewer is rejected."""


@dataclass(frozen=True, slots=True)
class PosePrior:
    """Prior knowledge of a pose."""

    pose: Pose
    """Expected pose."""
    covariance: Array
    """Covariance (6, 6) of a pose error: translation (metres, O_L), then rotation from the left (radians, O_C)."""


@dataclass(frozen=True, slots=True)
class Fix:
    """A pose estimated from craters."""

    pose: Pose
    """Estimated pose."""
    covariance: Array
    """Covariance (6, 6) of the pose error, as in `PosePrior`."""
    sighting: NDArray[np.integer]
    """Indices of the matched sightings (K,)."""
    crater: NDArray[np.integer]
    """Index in the catalogue of the crater of each match (K,)."""
    weight: Array
    """Weights of the matches (K,), from 0 for outliers to 1."""
    rms_px: float
    """Root mean square distance between matched centres, per axis."""


def refine(sightings: Sightings, catalogue: Catalogue, camera: Camera, prior: PosePrior, start: Pose) -> Fix | None:
    """Estimate the best-fitting pose from a start that is correct to a few pixels; None if too few sightings match."""
    if not len(sightings):
        return None
    precision = np.linalg.inv(prior.covariance)
    pose, noise_px = start, np.hypot(sightings.noise_px, sightings.static_px)
    size, size_sigma = np.log(sightings.radius_px), float(np.hypot(sightings.size_sigma, catalogue.radius_sigma_share))
    least_px = _LEAST_SIZE * float(sightings.radius_px.min())
    in_field = in_view(catalogue, camera, start, _FARTHEST_PX, _SMALLER * least_px)
    catalogue = catalogue.part(in_field)
    for gate_px in _GATES_PX:
        expected = projected(catalogue, camera, pose, 3 * gate_px, least_px)
        placed_px = camera.fx_px / expected.depth_m * catalogue.position_sigma_m
        seen_circles = Circles(sightings.centre_px, size, np.hypot(noise_px, gate_px))
        expected_circles = Circles(expected.centre_px, np.log(expected.radius_px), placed_px)
        sighting, crater, error = matched(
            seen_circles, expected_circles, size_sigma**2 + (gate_px / 60) ** 2, _GATE_SIGMAS
        )
        if len(sighting) < _LEAST_MATCHES:
            return None
        centre_sigma = np.hypot(noise_px[sighting], placed_px[crater])
        weight, normal, gradient = _normal_equations(
            error, centre_sigma, size_sigma, gate_px, expected.jacobian(crater)
        )
        normal += precision
        gradient -= precision @ _offset(pose, prior.pose)
        pose = pose.changed(np.linalg.solve(normal, gradient))
    if len(sighting) < _LEAST_SHARE * len(sightings):
        return None
    # If the assumed errors are too small for the residuals, enlarge the covariance to match the residuals.
    squares = np.sum(weight[:, None] * (error[:, :2] / centre_sigma[:, None]) ** 2)
    factor = max(1.0, float(squares / max(2 * weight.sum() - 6, 1.0)))
    covariance = factor * np.linalg.inv(normal)
    covariance[3:5, 3:5] += np.eye(2) * (COMMON_PX / camera.fx_px) ** 2
    return Fix(
        pose, covariance, sighting, in_field[expected.index[crater]], weight, float(np.sqrt(np.mean(error[:, :2] ** 2)))
    )


@compiled
def _normal_equations(
    error: Array, centre_sigma: Array, size_sigma: float, gate_px: float, jacobian: Array
) -> tuple[Array, Array, Array]:
    """Weights (K,) of K matches, normal matrix (6, 6) and right side (6,) of a Gauss-Newton step of the pose.

    `error` (K, 3) holds the differences in centre and size. `centre_sigma` (K,) and `size_sigma` are the standard
    deviations of these differences. `gate_px` is the uncertainty of the pose, and `jacobian` (K, 3, 6) holds the
    derivatives with respect to the step.
    """
    weight, normal, right = np.empty(len(error)), np.zeros((6, 6)), np.zeros(6)
    for k in range(len(error)):
        squared = (error[k, 0] ** 2 + error[k, 1] ** 2) / (centre_sigma[k] ** 2 + gate_px**2) / 2
        weight[k] = max(1 - squared / _TUKEY**2, 0.0) ** 2
        for part in range(3):
            precision = weight[k] / (size_sigma if part == 2 else centre_sigma[k]) ** 2
            for i in range(6):
                along = precision * jacobian[k, part, i]
                right[i] += along * error[k, part]
                for j in range(i + 1):
                    normal[i, j] += along * jacobian[k, part, j]
    for i in range(6):
        for j in range(i):
            normal[j, i] = normal[i, j]
    return weight, normal, right


def _offset(pose: Pose, prior: Pose) -> Array:
    """The step (6,) from the prior pose to `pose`."""
    turn = rotation_vectors(pose.rotation_camera_from_site @ prior.rotation_camera_from_site.T)
    return np.concatenate([pose.position_m - prior.position_m, turn])
