"""A camera's pose from craters that are matched to a catalogue, starting near the true pose.

One-to-one assignment within a gate that narrows, then Gauss-Newton on the centres of the ellipses with Tukey's weights
(Beaton & Tukey 1974, doi 10.1080/00401706.1974.10489171), repeated. The centres of the ellipses are projected exactly,
so the offset between them and the images of the circles' centres is no error.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_train.navigate.craters.catalogue import Catalogue
from perilune_train.navigate.craters.projection import Pose, Projected, in_view, projected
from perilune_train.navigate.craters.sightings import Sightings

_GATES_PX = (6.0, 3.0, 1.5, 0.0, 0.0, 0.0)
"""Uncertainty of the pose in each round, pixels, beside that of the sightings."""
_GATE_SIGMAS = 3.5
_FORBIDDEN = 1e6
_FARTHEST_PX, _SMALLER = 64.0, 0.8
"""Craters beside the image at the start by more pixels, or below a share of the least size, are left out of all rounds.
The start is right to a few pixels; the rounds look 18 px beside the image."""
_TUKEY = 4.685
COMMON_PX = 0.08
"""Standard deviation of an error that all centres of a frame share, pixels."""
_LEAST_SIZE = 0.7
"""Radius of the smallest crater that is matched, by that of the smallest sighting."""
_LEAST_MATCHES = 6
_LEAST_SHARE = 0.3
"""Share of the sightings that must be matched; a fix with fewer is none."""


@dataclass(frozen=True, slots=True)
class PosePrior:
    """What is known of a pose before."""

    pose: Pose
    """Expected pose."""
    covariance: Array
    """Of a step of the pose (6, 6): shift in O_L, metres, turn from the left, radians, O_C."""


@dataclass(frozen=True, slots=True)
class Fix:
    """A pose from craters."""

    pose: Pose
    """Estimated pose."""
    covariance: Array
    """Of a step of the pose (6, 6), as in `PosePrior`."""
    sighting: NDArray[np.integer]
    """Matched sightings (K,)."""
    crater: NDArray[np.integer]
    """Their craters in the catalogue (K,)."""
    weight: Array
    """Weights of the matches (K,), from 0 for outliers to 1."""
    rms_px: float
    """Root mean square distance of the matches, per axis."""


def refine(sightings: Sightings, catalogue: Catalogue, camera: Camera, prior: PosePrior, start: Pose) -> Fix | None:
    """The pose that fits best, from a start within a few pixels; None if too few sightings can be matched."""
    precision = np.linalg.inv(prior.covariance)
    pose = start
    least_px = _LEAST_SIZE * float(sightings.radius_px.min()) if len(sightings) else 1.0
    places = in_view(catalogue, camera, start, _FARTHEST_PX, _SMALLER * least_px)
    catalogue = catalogue.part(places)
    for gate_px in _GATES_PX:
        seen = projected(catalogue, camera, pose, 3 * gate_px, least_px)
        own, other = _matches(sightings, seen, catalogue, camera, gate_px)
        if len(own) < _LEAST_MATCHES:
            return None
        error, sigma = _errors(sightings, seen, catalogue, camera, own, other)
        distance = np.linalg.norm(error[:, :2] / np.hypot(sigma[:, :2], gate_px), axis=1) / np.sqrt(2)
        weight = np.clip(1 - (distance / _TUKEY) ** 2, 0, None) ** 2
        jacobian = seen.jacobian[other] / sigma[:, :, None]
        normal = np.einsum("n,nij,nik->jk", weight, jacobian, jacobian) + precision
        gradient = np.einsum("n,nij,ni->j", weight, jacobian, error / sigma) - precision @ _offset(pose, prior.pose)
        pose = pose.changed(np.linalg.solve(normal, gradient))
    if len(own) < _LEAST_SHARE * len(sightings):
        return None
    # Stated errors that are too small must not make the fix look better than it is.
    squares = np.sum(weight[:, None] * (error[:, :2] / sigma[:, :2]) ** 2)
    factor = max(1.0, float(squares / max(2 * weight.sum() - 6, 1.0)))
    covariance = factor * np.linalg.inv(normal)
    covariance[3:5, 3:5] += np.eye(2) * (COMMON_PX / camera.fx_px) ** 2
    return Fix(pose, covariance, own, places[seen.index[other]], weight, float(np.sqrt(np.mean(error[:, :2] ** 2))))


def _matches(
    sightings: Sightings, seen: Projected, catalogue: Catalogue, camera: Camera, gate_px: float
) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """One-to-one matches within the gate: places in `sightings` and in `seen` (K,)."""
    mapped = camera.fx_px / seen.depth_m * catalogue.position_sigma_m
    own_variance = sightings.noise_px**2 + sightings.static_px**2 + gate_px**2
    own, other = _near(sightings, seen, own_variance + np.max(mapped, initial=0.0) ** 2)
    across = sightings.centre_px[own] - seen.centre_px[other]
    variance = own_variance[own] + mapped[other] ** 2
    ratio = np.log(sightings.radius_px[own] / seen.radius_px[other])
    size_variance = sightings.size_sigma**2 + catalogue.radius_sigma_share**2 + (gate_px / 60) ** 2
    cost = (across**2).sum(axis=1) / variance / 2 + ratio**2 / size_variance
    allowed = cost < _GATE_SIGMAS**2
    if not allowed.any():
        return np.zeros(0, int), np.zeros(0, int)
    costs = np.full((len(sightings), len(seen.index)), _FORBIDDEN)
    costs[own[allowed], other[allowed]] = cost[allowed]
    own, other = linear_sum_assignment(costs)
    kept = costs[own, other] < _FORBIDDEN
    return own[kept], other[kept]


def _near(sightings: Sightings, seen: Projected, variance: Array) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """Pairs that are near enough for the gate (K,), by the largest variance (M,) that a pair of a sighting can have."""
    if not len(seen.index) or not len(sightings):
        return np.zeros(0, int), np.zeros(0, int)
    near = KDTree(seen.centre_px).query_ball_point(sightings.centre_px, _GATE_SIGMAS * np.sqrt(2 * variance))
    counts = [len(one) for one in near]
    return np.repeat(np.arange(len(near)), counts), np.concatenate(near).astype(int)


def _errors(
    sightings: Sightings,
    seen: Projected,
    catalogue: Catalogue,
    camera: Camera,
    own: NDArray[np.integer],
    other: NDArray[np.integer],
) -> tuple[Array, Array]:
    """Differences of centre and logarithm of radius (K, 3), sighting less projection, and their deviations (K, 3)."""
    ratio = np.log(sightings.radius_px[own] / seen.radius_px[other])
    error = np.column_stack([sightings.centre_px[own] - seen.centre_px[other], ratio])
    placed = camera.fx_px / seen.depth_m[other] * catalogue.position_sigma_m
    centre = np.sqrt(sightings.noise_px[own] ** 2 + sightings.static_px[own] ** 2 + placed**2)
    size = np.hypot(sightings.size_sigma, catalogue.radius_sigma_share)
    return error, np.column_stack([centre, centre, np.full(len(own), size)])


def _offset(pose: Pose, prior: Pose) -> Array:
    """The step (6,) from the prior's pose to a pose."""
    turn = rotation_vectors(pose.rotation_camera_from_site @ prior.rotation_camera_from_site.T)
    return np.concatenate([pose.position_m - prior.position_m, turn])
