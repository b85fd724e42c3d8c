"""Measurement models of the filter: craters, and poses estimated from craters."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector, rotation_vectors
from perilune_train.compiled import compiled
from perilune_train.landing.craters.ambiguity import match_probability
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.fix import Fix
from perilune_train.landing.craters.projection import Pose, in_view, projected
from perilune_train.landing.craters.sightings import STATIC_SHARE, Sightings
from perilune_train.landing.filter.state import (
    ATTITUDE,
    COMMON,
    MOUNTING,
    N_ERRORS,
    POSITION,
    TIME_TAG,
    State,
    common_pattern,
)
from perilune_train.landing.filter.update import gate, updated

_MIN_PROBABILITY = 0.8
"""Matches that are correct with a smaller probability are left out of the update."""
_MIN_WEIGHT = 0.1
"""Matches with a smaller weight in the fix are ignored."""
_ALL_SEE = np.r_[POSITION, ATTITUDE, COMMON, MOUNTING, TIME_TAG]
"""Parts of the error state that displace every sighting."""
_COMMON_SEEN = slice(6, 11)
"""The part COMMON within `_ALL_SEE`."""


def pose_squared(state: State, pose: Pose, covariance: Array, rotation_camera_from_body: Array) -> float:
    """Squared normalised innovation of a camera pose; the pose has six numbers.

    `covariance` (6, 6) is the covariance of the pose error, as in `PosePrior`.
    """
    innovation, by_error = _pose_innovation(state, pose, rotation_camera_from_body)
    spread = by_error @ state.covariance[:N_ERRORS, :N_ERRORS] @ by_error.T + covariance
    return float(innovation @ np.linalg.solve(spread, innovation))


def camera_pose(state: State, rotation_camera_from_body: Array) -> tuple[Pose, Array]:
    """The expected camera pose at the exposure of a frame, and the derivative (6, 25) of its error.

    The time tag of the frame is the time of the state. Mounting and time tag are corrected by the state's estimates.
    The derivative is with respect to the error state; `PosePrior` defines the pose error.
    """
    mounted = matrix_from_rotation_vector(state.mounting_rad) @ rotation_camera_from_body
    later = matrix_from_rotation_vector(-state.angular_rate_radps * state.time_tag_s)
    camera_from_body = mounted @ later
    by_error = np.zeros((6, N_ERRORS))
    by_error[:3, POSITION] = np.eye(3)
    by_error[:3, TIME_TAG] = state.velocity_mps[:, None]
    # R_camera_from_site = C R^T. Replacing R by R exp(e) rotates it by -C e from the left.
    by_error[3:, ATTITUDE] = -camera_from_body
    by_error[3:, MOUNTING] = np.eye(3)
    by_error[3:, TIME_TAG] = -(mounted @ state.angular_rate_radps)[:, None]
    position_m = state.position_m + state.velocity_mps * state.time_tag_s
    return Pose(position_m, camera_from_body @ state.rotation_site_from_body.T), by_error


def _pose_innovation(state: State, pose: Pose, rotation_camera_from_body: Array) -> tuple[Array, Array]:
    """Translation and rotation (6,) from the expected pose, and the derivative (6, 25) of its error."""
    expected, by_error = camera_pose(state, rotation_camera_from_body)
    turn = rotation_vectors(pose.rotation_camera_from_site @ expected.rotation_camera_from_site.T)
    return np.concatenate([pose.position_m - expected.position_m, turn]), by_error


def craters_update(
    state: State,
    fix: Fix,
    sightings: Sightings,
    catalogue: Catalogue,
    camera: Camera,
    rotation_camera_from_body: Array,
) -> State:
    """The state after an update with the craters that a fix has matched, as `crater_innovations` compares them."""
    measured = crater_innovations(state, fix, sightings, catalogue, camera, rotation_camera_from_body)
    return updated(measured.state, measured.innovation_px.ravel(), measured.crossed, measured.spread)


@dataclass(frozen=True, slots=True)
class CraterInnovations:
    """The sightings of N matched craters that agree with the state."""

    state: State
    """The state with the offsets of these craters and of the unmatched craters that remain in view."""
    match: NDArray[np.integer]
    """Indices of the matches in the fix (N,)."""
    innovation_px: Array
    """Sighting minus predicted centre (N, 2), pixels."""
    crossed: Array
    """Covariance (2 N, M) of the innovations with the error state."""
    spread: Array
    """Covariance (2 N, 2 N) of the innovations, with noise."""


def crater_innovations(
    state: State,
    fix: Fix,
    sightings: Sightings,
    catalogue: Catalogue,
    camera: Camera,
    rotation_camera_from_body: Array,
) -> CraterInnovations:
    """Compare the sightings of a fix with the state's prediction, which includes the offsets of the craters.

    Unmatched craters in view stay in the state. If a crater that the detector missed in one frame were removed, the
    next frame would treat the crater's catalogue error as a new, independent error.

    Ambiguous matches are left out, and so is a sighting that contradicts the state and its crater's offset.

    The measurement is linearised about the fix, which is closer to the true pose than the state is (iterated filter,
    Bell & Cathey 1993, doi 10.1109/9.250476).
    """
    is_likely = match_probability(sightings, catalogue, camera, fix) >= _MIN_PROBABILITY
    used = np.flatnonzero(is_likely & (fix.weight > _MIN_WEIGHT))
    sighting, crater, weight = fix.sighting[used], fix.crater[used], fix.weight[used]
    unmatched = np.setdiff1d(state.craters, crater)
    unmatched = unmatched[in_view(catalogue.part(unmatched), camera, fix.pose, 0.0, 0.0)]
    known = np.concatenate([crater, unmatched])
    static_m = STATIC_SHARE * catalogue.radius_m[known]
    if sightings.sigma_px is not None:
        depth_m = (catalogue.centre_m[crater] - fix.pose.position_m) @ fix.pose.rotation_camera_from_site[2]
        predicted_m = depth_m / camera.fx_px * sightings.static_px[sighting]
        is_predicted = ~np.isnan(sightings.sigma_px[sighting])
        static_m[: len(crater)] = np.where(is_predicted, predicted_m, static_m[: len(crater)])
    state = state.with_craters(known, np.hypot(catalogue.position_sigma_m, static_m))
    seen = projected(catalogue.part(crater), camera, fix.pose, margin_px=np.inf, least_radius_px=0.0)
    by_pose = seen.jacobian()[:, :2]
    expected, pose_by_error = camera_pose(state, rotation_camera_from_body)
    turn = rotation_vectors(expected.rotation_camera_from_site @ fix.pose.rotation_camera_from_site.T)
    from_fix = np.concatenate([expected.position_m - fix.pose.position_m, turn])
    # Shifting a crater has the effect of shifting the camera in the opposite direction.
    by_offset = -by_pose[:, :, :2]
    pattern = common_pattern(camera.rays(seen.centre_px)[:, :2])
    predicted = (
        seen.centre_px
        + by_pose @ from_fix
        + np.einsum("nij,nj->ni", by_offset, state.offsets_m[seen.index])
        + pattern @ state.common_px
    )
    by_error = by_pose @ pose_by_error[:, _ALL_SEE]
    by_error[:, :, _COMMON_SEEN] += pattern
    innovation_px = sightings.centre_px[sighting[seen.index]] - predicted
    variance = sightings.noise_px[sighting[seen.index]] ** 2 / weight[seen.index]
    # Height errors of the catalogue shift craters in the image radially. They are added as noise: as parts of the state
    # they made it half as large again and gave equal errors and normalised errors.
    by_height = catalogue.position_sigma_m * by_pose[:, :, 2]
    noise = variance[:, None, None] * np.eye(2) + by_height[:, :, None] * by_height[:, None, :]
    crossed, spread = _crossed(state, seen.index, by_error, by_offset)
    number = np.arange(len(noise))
    spread.reshape(len(noise), 2, len(noise), 2)[number, :, number] += noise
    own = spread.reshape(len(noise), 2, len(noise), 2)[number, :, number]
    squared = np.einsum("ni,ni->n", innovation_px, np.linalg.solve(own, innovation_px[:, :, None])[:, :, 0])
    accepted = np.flatnonzero(squared <= gate(2))
    part = np.flatnonzero(np.repeat(squared <= gate(2), 2))
    match = used[seen.index[accepted]]
    return CraterInnovations(state, match, innovation_px[accepted], crossed[part], spread[np.ix_(part, part)])


def _crossed(state: State, crater: NDArray[np.integer], by_error: Array, by_offset: Array) -> tuple[Array, Array]:
    """Covariances of N noise-free sightings: with the error state (2 N, M), with each other (2 N, 2 N).

    `by_error` (N, 2, 15) and `by_offset` (N, 2, 2) are the derivatives of the sightings with respect to the errors
    `_ALL_SEE` and to the offsets of their craters. `crater` (N,) gives the index in the state of each sighting's
    crater. All other derivatives are zero.
    """
    by_error = by_error.reshape(-1, len(_ALL_SEE))
    crossed = by_error @ state.covariance[_ALL_SEE]
    first = N_ERRORS + 2 * crater
    _add_offsets(crossed, by_offset, state.covariance, first)
    spread = crossed[:, _ALL_SEE] @ by_error.T
    _add_own(spread, by_offset, crossed, first)
    return crossed, spread


@compiled
def _add_offsets(crossed: Array, by_offset: Array, covariance: Array, first: NDArray[np.int64]) -> None:
    """Add the contribution of craters' offsets, which begin at rows `first` of the state, to `crossed`."""
    for k in range(len(first)):
        east = first[k]
        for axis in range(2):
            row, by_east, by_north = crossed[2 * k + axis], by_offset[k, axis, 0], by_offset[k, axis, 1]
            for column in range(len(row)):
                row[column] += by_east * covariance[east, column] + by_north * covariance[east + 1, column]


@compiled
def _add_own(spread: Array, by_offset: Array, crossed: Array, first: NDArray[np.int64]) -> None:
    """Add the contribution of craters' offsets, which begin at rows `first` of the state, to `spread`."""
    for row in range(len(crossed)):
        for k in range(len(first)):
            east = first[k]
            for axis in range(2):
                spread[row, 2 * k + axis] += (
                    by_offset[k, axis, 0] * crossed[row, east] + by_offset[k, axis, 1] * crossed[row, east + 1]
                )
