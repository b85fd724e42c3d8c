"""A camera's pose from craters that are matched to a catalogue, starting near the true pose.

One-to-one assignment within a gate that narrows, then Gauss-Newton on the centres of the ellipses with Tukey's weights
(Beaton & Tukey 1974, doi 10.1080/00401706.1974.10489171), repeated. The centres of the ellipses are projected exactly,
so the offset between them and the images of the circles' centres is no error.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

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
    if not len(sightings):
        return None
    precision = np.linalg.inv(prior.covariance)
    pose, noise_px = start, np.hypot(sightings.noise_px, sightings.static_px)
    size_sigma = float(np.hypot(sightings.size_sigma, catalogue.radius_sigma_share))
    least_px = _LEAST_SIZE * float(sightings.radius_px.min())
    places = in_view(catalogue, camera, start, _FARTHEST_PX, _SMALLER * least_px)
    catalogue = catalogue.part(places)
    for gate_px in _GATES_PX:
        seen = projected(catalogue, camera, pose, 3 * gate_px, least_px)
        placed_px = camera.fx_px / seen.depth_m * catalogue.position_sigma_m
        own_px = np.hypot(noise_px, gate_px)
        reach_px = _GATE_SIGMAS * np.sqrt(2 * (own_px**2 + np.max(placed_px, initial=0.0) ** 2))
        own, other = _near(sightings, seen, reach_px)
        error = _errors(sightings, seen, own, other)
        cost = (error[:, :2] ** 2).sum(axis=1) / (own_px[own] ** 2 + placed_px[other] ** 2) / 2
        cost += error[:, 2] ** 2 / (size_sigma**2 + (gate_px / 60) ** 2)
        matched = _assigned(own, other, cost)
        if len(matched) < _LEAST_MATCHES:
            return None
        own, other, error = own[matched], other[matched], error[matched]
        centre_sigma = np.hypot(noise_px[own], placed_px[other])
        sigma = np.column_stack([centre_sigma, centre_sigma, np.full(len(own), size_sigma)])
        distance = np.sqrt((error[:, :2] ** 2).sum(axis=1) / (centre_sigma**2 + gate_px**2) / 2)
        weight = np.clip(1 - (distance / _TUKEY) ** 2, 0, None) ** 2
        jacobian = (seen.jacobian(other) / sigma[:, :, None]).reshape(-1, 6)
        weighted = np.repeat(weight, 3)[:, None] * jacobian
        normal = weighted.T @ jacobian + precision
        gradient = (error / sigma).ravel() @ weighted - precision @ _offset(pose, prior.pose)
        pose = pose.changed(np.linalg.solve(normal, gradient))
    if len(own) < _LEAST_SHARE * len(sightings):
        return None
    # Stated errors that are too small must not make the fix look better than it is.
    squares = np.sum(weight[:, None] * (error[:, :2] / sigma[:, :2]) ** 2)
    factor = max(1.0, float(squares / max(2 * weight.sum() - 6, 1.0)))
    covariance = factor * np.linalg.inv(normal)
    covariance[3:5, 3:5] += np.eye(2) * (COMMON_PX / camera.fx_px) ** 2
    return Fix(pose, covariance, own, places[seen.index[other]], weight, float(np.sqrt(np.mean(error[:, :2] ** 2))))


def _near(sightings: Sightings, seen: Projected, reach_px: Array) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """All pairs that are at most `reach_px` (M,) apart along each axis: places in `sightings` and in `seen` (K,)."""
    order = np.argsort(seen.centre_px[:, 0])
    x, y = seen.centre_px[order].T
    first = np.searchsorted(x, sightings.centre_px[:, 0] - reach_px)
    count = np.searchsorted(x, sightings.centre_px[:, 0] + reach_px, side="right") - first
    own = np.repeat(np.arange(len(sightings)), count)
    other = np.arange(len(own)) + np.repeat(first - np.cumsum(count) + count, count)
    near = np.abs(sightings.centre_px[own, 1] - y[other]) <= reach_px[own]
    return own[near], order[other[near]]


def _assigned(own: NDArray[np.integer], other: NDArray[np.integer], cost: Array) -> NDArray[np.integer]:
    """The pairs of the one-to-one assignment of most pairs within the gate and of least cost, by increasing `own`."""
    allowed = np.flatnonzero(cost < _GATE_SIGMAS**2)
    if not len(allowed):
        return allowed
    # Pairs without a rival belong to every such assignment; without them the rest is small.
    own, other = own[allowed], other[allowed]
    alone = (np.bincount(own)[own] == 1) & (np.bincount(other)[other] == 1)
    rivals = allowed[~alone]
    rows, row = _numbered(own[~alone])
    columns, column = _numbered(other[~alone])
    costs, pair = np.full((rows, columns), _FORBIDDEN), np.zeros((rows, columns), int)
    costs[row, column], pair[row, column] = cost[rivals], rivals
    chosen = linear_sum_assignment(costs)
    matched = np.concatenate([allowed[alone], pair[chosen][costs[chosen] < _FORBIDDEN]])
    return np.sort(matched)


def _numbered(places: NDArray[np.integer]) -> tuple[int, NDArray[np.integer]]:
    """The number of different places, and the places numbered without gaps."""
    different = np.flatnonzero(np.bincount(places))
    return len(different), np.searchsorted(different, places)


def _errors(sightings: Sightings, seen: Projected, own: NDArray[np.integer], other: NDArray[np.integer]) -> Array:
    """Differences of centre and logarithm of radius (K, 3), sighting less projection."""
    error = np.empty((len(own), 3))
    error[:, :2] = sightings.centre_px[own] - seen.centre_px[other]
    error[:, 2] = np.log(sightings.radius_px[own] / seen.radius_px[other])
    return error


def _offset(pose: Pose, prior: Pose) -> Array:
    """The step (6,) from the prior's pose to a pose."""
    turn = rotation_vectors(pose.rotation_camera_from_site @ prior.rotation_camera_from_site.T)
    return np.concatenate([pose.position_m - prior.position_m, turn])
