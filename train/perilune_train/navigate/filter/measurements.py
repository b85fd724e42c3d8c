"""Ranges, poses from craters, and relative motions as measurements of the state."""

import numpy as np
from scipy.linalg import block_diag

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_train.navigate.craters.catalogue import Catalogue
from perilune_train.navigate.craters.fix import Fix
from perilune_train.navigate.craters.projection import in_view, projected
from perilune_train.navigate.craters.sightings import STATIC_SHARE, Sightings
from perilune_train.navigate.filter.state import (
    ATTITUDE,
    COMMON,
    GROUND,
    LAST_ATTITUDE,
    LAST_POSITION,
    N_ERRORS,
    POSITION,
    State,
    common_pattern,
)
from perilune_train.navigate.filter.update import Update, updated

_LEAST_WEIGHT = 0.1
"""Matches with a smaller weight in a fix are not used."""


def range_update(state: State, range_m: float, ground_m: float, sigma_m: float) -> Update:
    """Update by the distance to the ground along -Z_B.

    `ground_m` is the height of the ground as the nearest craters have it, `sigma_m` the deviation of the instrument.
    """
    rotation, height_m = state.rotation_site_from_body, state.position_m[2] - ground_m - state.ground_m
    cosine = rotation[2, 2]
    by_error = np.zeros((1, N_ERRORS))
    by_error[0, 2], by_error[0, GROUND] = 1 / cosine, -1 / cosine
    by_error[0, ATTITUDE] = -height_m / cosine**2 * np.array([-rotation[2, 1], rotation[2, 0], 0])
    return updated(state, np.array([range_m - height_m / cosine]), by_error, np.array([[sigma_m**2]]))


def pose_update(
    state: State,
    position_m: Array,
    rotation_camera_from_site: Array,
    covariance: Array,
    rotation_camera_from_body: Array,
) -> Update:
    """Update by a pose of the camera.

    `covariance` (6, 6) is that of the shift, O_L, metres, and of the turn from the left, O_C, radians.
    """
    expected = rotation_camera_from_body @ state.rotation_site_from_body.T
    turn = rotation_vectors(rotation_camera_from_site @ expected.T)
    by_error = np.zeros((6, N_ERRORS))
    by_error[:3, POSITION] = np.eye(3)
    # R_camera_from_site = C R^T, and R exp(e) in the place of R turns it by -C e from the left.
    by_error[3:, ATTITUDE] = -rotation_camera_from_body
    return updated(state, np.concatenate([position_m - state.position_m, turn]), by_error, covariance)


def motion_update(
    state: State,
    translation_m: Array,
    rotation_c2_from_c1: Array,
    covariance: Array,
    rotation_camera_from_body: Array,
) -> Update:
    """Update by the motion of the camera since the last frame.

    `covariance` (6, 6) is that of an alignment: of the turn from the left, radians, and the shift, metres, O_C of the
    later frame.
    """
    mounting = rotation_camera_from_body
    first, second = (
        mounting @ rotation.T for rotation in (state.last_rotation_site_from_body, state.rotation_site_from_body)
    )
    turned = second @ first.T
    moved = first @ (state.position_m - state.last_position_m)
    turn = rotation_vectors(rotation_c2_from_c1 @ turned.T)
    innovation = np.concatenate([turn, turned @ (moved - translation_m)])
    by_error = np.zeros((6, N_ERRORS))
    by_error[:3, ATTITUDE], by_error[:3, LAST_ATTITUDE] = -mounting, turned @ mounting
    by_error[3:, POSITION], by_error[3:, LAST_POSITION] = -second, second
    x, y, z = moved
    by_error[3:, LAST_ATTITUDE] = -turned @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ mounting
    return updated(state, innovation, by_error, covariance)


def craters_update(
    state: State,
    fix: Fix,
    sightings: Sightings,
    catalogue: Catalogue,
    camera: Camera,
    rotation_camera_from_body: Array,
) -> Update:
    """Update by the craters that a fix has matched, with their offsets as part of the state.

    Craters that are in view but not matched stay in the state: a crater that is missed in one frame must not bring its
    error of the catalogue as new information in the next.
    The measurement is linear about the pose of the fix, which is nearer to the truth than the state (iterated filter,
    Bell & Cathey 1993, doi 10.1109/9.250476).
    """
    used = np.flatnonzero(fix.weight > _LEAST_WEIGHT)
    own, crater, weight = fix.sighting[used], fix.crater[used], fix.weight[used]
    unmatched = np.setdiff1d(state.craters, crater)
    unmatched = unmatched[in_view(catalogue.part(unmatched), camera, fix.pose, 0.0, 0.0)]
    known = np.concatenate([crater, unmatched])
    state = state.with_craters(known, np.hypot(catalogue.position_sigma_m, STATIC_SHARE * catalogue.radius_m[known]))
    seen = projected(catalogue.part(crater), camera, fix.pose, margin_px=np.inf, least_radius_px=0.0)
    by_pose = seen.jacobian[:, :2]
    expected = rotation_camera_from_body @ state.rotation_site_from_body.T
    turn = rotation_vectors(expected @ fix.pose.rotation_camera_from_site.T)
    from_fix = np.concatenate([state.position_m - fix.pose.position_m, turn])
    # A crater that is shifted one way looks like a camera that is shifted the other way.
    by_offset = -by_pose[:, :, :2]
    pattern = common_pattern(camera.rays(seen.centre_px)[:, :2])
    predicted = (
        seen.centre_px
        + by_pose @ from_fix
        + np.einsum("nij,nj->ni", by_offset, state.offsets_m[seen.index])
        + pattern @ state.common_px
    )
    n = len(seen.index)
    by_error = np.zeros((n, 2, N_ERRORS + 2 * len(known)))
    by_error[:, :, POSITION] = by_pose[:, :, :3]
    by_error[:, :, ATTITUDE] = by_pose[:, :, 3:] @ -rotation_camera_from_body
    by_error[:, :, COMMON] = pattern
    for axis in (0, 1):
        by_error[np.arange(n), :, N_ERRORS + 2 * seen.index + axis] = by_offset[:, :, axis]
    innovation = (sightings.centre_px[own[seen.index]] - predicted).ravel()
    variance = sightings.noise_px[own[seen.index]] ** 2 / weight[seen.index]
    # Errors of heights in the catalogue shift craters in the image, away from its middle. As parts of the state they
    # gave the same errors and normalised errors, for a state that is half as large again.
    by_height = catalogue.position_sigma_m * by_pose[:, :, 2]
    noise = variance[:, None, None] * np.eye(2) + by_height[:, :, None] * by_height[:, None, :]
    return updated(state, innovation, by_error.reshape(2 * n, -1), block_diag(*noise), gate=False)
