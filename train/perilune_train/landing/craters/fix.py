"""Estimate a camera's pose by matching craters to a catalogue, from a start near the true pose.

Each round projects the catalogue into the image, matches sightings and craters, and takes a Gauss-Newton step that fits
the centres and sizes of the ellipses. The first rounds are soft: each crater near a sighting is weighted by the
probability that the two match. The assumed error of the pose shrinks from round to round (annealed
expectation-maximisation, as in Chui & Rangarajan 2003, doi 10.1016/S1077-3142(03)00009-2). One-to-one matches within a
wide gate would converge to a wrong pose where craters are dense, even from the true pose. The last rounds match one to
one, with Tukey's weights (Beaton & Tukey 1974, doi 10.1080/00401706.1974.10489171). The ellipse centres are computed
exactly, because the centre of a circle does not project to the centre of its ellipse.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_train.compiled import compiled
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.matching import Circles, matched
from perilune_train.landing.craters.neighbours import within_reach
from perilune_train.landing.craters.projection import Pose, in_view, projected
from perilune_train.landing.craters.sightings import Sightings

_SOFT_PX = (6.0, 4.0, 2.5, 1.5, 1.0)
"""Error of the pose that each soft round assumes, pixels, in addition to the noise of the sightings."""
_SOFT_SIGMAS = 2.5
"""Largest distance of a crater from a sighting in a soft round, standard deviations."""
_CLUTTER_SHARE, SIZE_SPAN = 0.5, 2.0
"""Assumed share of false sightings, and the range of the logarithms of their radii."""
_N_HARD = 3
"""Number of one-to-one rounds at the end."""
_GATE_SIGMAS = 3.5
_FARTHEST_PX, _SMALLER = 64.0, 0.8
"""All rounds leave out craters that are farther outside the image than this, pixels, or smaller than this share of the
smallest radius to match. No match is lost: the start is correct to a few pixels, and the rounds consider craters up to
18 px outside the image."""
_TUKEY = 4.685
COMMON_PX = 0.08
"""Standard deviation, pixels, of the error that all centres in a frame share."""
MIN_SIZE_RATIO = 0.7
"""Radius of the smallest crater to match, as a share of the radius of the smallest sighting."""
MIN_MATCHES = 6
"""Smallest number of sightings with which a fix is possible."""


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
    """Root mean square distance between matched centres, per axis, pixels."""
    start: Pose
    """Pose from which the rounds started."""


def refine(
    sightings: Sightings,
    catalogue: Catalogue,
    camera: Camera,
    prior: PosePrior,
    start: Pose,
    start_px: float = _SOFT_PX[0],
    rounds: list[Pose] | None = None,
) -> Fix | None:
    """Estimate the best-fitting pose near a start; None if fewer than six sightings match.

    `start_px` is the standard deviation of the start's error in the image, pixels. If the start is far from the true
    pose, the result is wrong: use `vote.support` to compare the number of agreeing sightings with chance.
    The pose after each round is appended to `rounds`, for a trace.
    """
    if not len(sightings):
        return None
    precision = np.linalg.inv(prior.covariance)
    pose, noise_px = start, np.hypot(sightings.noise_px, sightings.static_px)
    size, size_sigma = np.log(sightings.radius_px), float(np.hypot(sightings.size_sigma, catalogue.radius_sigma_share))
    least_px = MIN_SIZE_RATIO * float(sightings.radius_px.min())
    in_field = in_view(catalogue, camera, start, _FARTHEST_PX, _SMALLER * least_px)
    catalogue = catalogue.part(in_field)
    clutter = _CLUTTER_SHARE / (1 - _CLUTTER_SHARE) / (camera.width_px * camera.height_px * SIZE_SPAN)
    for soft_px in _SOFT_PX[_first_round(start_px) :]:
        expected = projected(catalogue, camera, pose, 3 * soft_px, least_px)
        placed_px = camera.fx_px / expected.depth_m * catalogue.position_sigma_m
        sigma_px = np.hypot(noise_px, soft_px)
        reach_px = _SOFT_SIGMAS * np.hypot(sigma_px, np.max(placed_px, initial=0.0))
        first, crater = within_reach(sightings.centre_px, reach_px, expected.centre_px)
        normal, gradient = _soft_equations(
            Circles(sightings.centre_px, size, sigma_px),
            Circles(expected.centre_px, np.log(expected.radius_px), placed_px),
            first,
            crater,
            (size_sigma, clutter * len(expected.index), _SOFT_SIGMAS),
            expected.jacobian(),
        )
        pose = _stepped(pose, prior, precision, normal, gradient)
        if rounds is not None:
            rounds.append(pose)
    for number in range(_N_HARD):
        # In the first of these rounds, the pose still has the error of the last soft round.
        gate_px = 0.5 if number == 0 else 0.0
        expected = projected(catalogue, camera, pose, 3 * gate_px, least_px)
        placed_px = camera.fx_px / expected.depth_m * catalogue.position_sigma_m
        seen_circles = Circles(sightings.centre_px, size, np.hypot(noise_px, gate_px))
        expected_circles = Circles(expected.centre_px, np.log(expected.radius_px), placed_px)
        sighting, crater, error = matched(seen_circles, expected_circles, size_sigma**2, _GATE_SIGMAS)
        if len(sighting) < MIN_MATCHES:
            return None
        centre_sigma = np.hypot(noise_px[sighting], placed_px[crater])
        weight, normal, gradient = _normal_equations(
            error, centre_sigma, size_sigma, gate_px, expected.jacobian(crater)
        )
        pose = _stepped(pose, prior, precision, normal, gradient)
        if rounds is not None:
            rounds.append(pose)
    normal += precision
    # If the assumed errors are too small for the residuals, enlarge the covariance to match the residuals.
    squares = np.sum(weight[:, None] * (error[:, :2] / centre_sigma[:, None]) ** 2)
    factor = max(1.0, float(squares / max(2 * weight.sum() - 6, 1.0)))
    covariance = factor * np.linalg.inv(normal)
    covariance[3:5, 3:5] += np.eye(2) * (COMMON_PX / camera.fx_px) ** 2
    rms_px = float(np.sqrt(np.mean(error[:, :2] ** 2)))
    return Fix(pose, covariance, sighting, in_field[expected.index[crater]], weight, rms_px, start)


def _first_round(start_px: float) -> int:
    """Index of the first soft round: the last round that assumes at least 1.5 times the start's error."""
    return max(sum(soft_px >= 1.5 * start_px for soft_px in _SOFT_PX) - 1, 0)


def _stepped(pose: Pose, prior: PosePrior, precision: Array, normal: Array, gradient: Array) -> Pose:
    """The pose after a Gauss-Newton step, with the prior as a further measurement."""
    return pose.changed(np.linalg.solve(normal + precision, gradient - precision @ _offset(pose, prior.pose)))


@compiled
def _soft_equations(
    seen: Circles,
    craters: Circles,
    first: NDArray[np.int64],
    crater: NDArray[np.int64],
    limits: tuple[float, float, float],
    jacobian: Array,
) -> tuple[Array, Array]:
    """Normal matrix (6, 6) and right side (6,) over all pairs of a soft round.

    A pair is weighted by the probability that it is correct. `first` and `crater` list the pairs as
    `within_reach` does. `limits` holds the standard deviation of a size, the density of false sightings relative to one
    crater (per pixel squared and per unit of size), and the largest distance in standard deviations. `jacobian` (N, 3,
    6) holds the derivatives of each crater with respect to the pose step.
    """
    size_sigma, clutter, farthest = limits
    normal, right = np.zeros((6, 6)), np.zeros(6)
    likelihood = np.empty(len(crater))
    error = np.empty(3)
    for i in range(len(seen.size)):
        total = clutter
        for k in range(first[i], first[i + 1]):
            j = crater[k]
            variance = seen.sigma_px[i] ** 2 + craters.sigma_px[j] ** 2
            apart = (seen.centre_px[i, 0] - craters.centre_px[j, 0]) ** 2
            apart = (apart + (seen.centre_px[i, 1] - craters.centre_px[j, 1]) ** 2) / variance
            sized = ((seen.size[i] - craters.size[j]) / size_sigma) ** 2
            likelihood[k] = 0.0
            if apart <= farthest**2 and sized <= farthest**2:
                likelihood[k] = np.exp(-(apart + sized) / 2) / (15.75 * variance * size_sigma)
            total += likelihood[k]
        for k in range(first[i], first[i + 1]):
            if likelihood[k] == 0.0:
                continue
            j = crater[k]
            probability = likelihood[k] / total
            error[0] = seen.centre_px[i, 0] - craters.centre_px[j, 0]
            error[1] = seen.centre_px[i, 1] - craters.centre_px[j, 1]
            error[2] = seen.size[i] - craters.size[j]
            variance = seen.sigma_px[i] ** 2 + craters.sigma_px[j] ** 2
            for part in range(3):
                precision = probability / (size_sigma**2 if part == 2 else variance)
                for a in range(6):
                    along = precision * jacobian[j, part, a]
                    right[a] += along * error[part]
                    for b in range(a + 1):
                        normal[a, b] += along * jacobian[j, part, b]
    for a in range(6):
        for b in range(a):
            normal[b, a] = normal[a, b]
    return normal, right


@compiled
def _normal_equations(
    error: Array, centre_sigma: Array, size_sigma: float, gate_px: float, jacobian: Array
) -> tuple[Array, Array, Array]:
    """Weights (K,) of K matches; normal matrix (6, 6) and right side (6,) of a Gauss-Newton step.

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
