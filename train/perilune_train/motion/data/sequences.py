"""Sequences of image pairs for the networks, and their augmentation."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_train.data.frames import normalised
from perilune_train.motion.data.trajectories import Trajectory
from perilune_train.motion.geometry import apply_homography, pixel_index_homography, plane_homography


@dataclass(frozen=True, slots=True)
class Jitter:
    """Standard deviations of the random extra motion of each training pair."""

    translation_m: Array
    """Shift of the second camera along x, y, z of O_C, metres (3,)."""
    rotation_rad: float
    """Rotation of the second camera about each axis, radians."""


@dataclass(frozen=True, slots=True)
class Sequence:
    """n pairs as network input, with their true motions."""

    first: np.ndarray
    """Earlier frames, normalised, float32 (n, height, width)."""
    second: np.ndarray
    """Later frames, like `first`; for warp resampled onto the earlier frames, and 0 beyond the edge of the later
    frame."""
    translation_m: Array
    """True translations (n, 3), metres."""
    rotation_c2_from_c1: Array
    """True rotations (n, 3, 3)."""
    nominal_translation_m: Array
    """Nominal translations (n, 3), metres."""
    altitude_m: Array
    """Nominal altitudes (n,), metres, at the earlier frames."""
    down_c: Array
    """Unit vector (3,), O_C, towards the ground if the body is level. Augmentation mirrors it with the frames."""
    flow_px: Array | None = None
    """For warp: residual flow of the ground plane (n, height / 8, width / 8, 2), pixels, from first to second."""


def pair_sequence(
    trajectory: Trajectory,
    start: int,
    n_pairs: int,
    *,
    warp: bool,
    rng: np.random.Generator | None = None,
    jitter: Jitter | None = None,
) -> Sequence:
    """Pairs start to start + n_pairs - 1 of a trajectory; augmented if a generator is given.

    Augmentation applies one of the eight symmetries of the square image to the whole sequence (four if the image is not
    square). With `jitter` it also moves the second camera of each pair at random, so that a pair has another motion in
    every epoch. The second frame is then resampled over the ground plane to the view of the moved camera. The plane has
    the nominal altitude and attitude.

    The resampled frame is exact for a pure rotation, or if the ground is flat and the true altitude and attitude are
    nominal. In other cases it is approximate. Example: the true poses differ from the nominal ones by 8 m and 0.3
    degrees, and the jitter is 0.3 times as large. The jitter then moves points by 1.2 px with an error of 0.04 px
    (0.14 px at 200 m). These are RMS values for frames of 128 px over 50 degrees at 200 to 1500 m; see
    tests/train/motion/test_data.py.
    """
    span = slice(start, start + n_pairs)
    translation, rotation_c2_from_c1 = (values[span] for values in trajectory.motion)
    nominal_translation, nominal_rotation = (values[span] for values in trajectory.nominal_motion)
    altitude = trajectory.altitude_m[span]
    images = trajectory.images[start : start + n_pairs + 1]
    translation, rotation_c2_from_c1, seconds = translation.copy(), rotation_c2_from_c1.copy(), []
    for i in range(n_pairs):
        change = np.eye(3)
        if rng is not None and jitter is not None:
            shift = rng.normal(size=3) * jitter.translation_m
            turn = matrix_from_rotation_vector(rng.normal(size=3) * jitter.rotation_rad)
            true = _homography(
                trajectory.camera, trajectory.down_c, translation[i], rotation_c2_from_c1[i], altitude[i]
            )
            translation[i], rotation_c2_from_c1[i] = translation[i] + shift, turn @ rotation_c2_from_c1[i]
            # Map image 2 of the moved camera to image 1 over the plane, then to the original image 2.
            moved = _homography(
                trajectory.camera, trajectory.down_c, translation[i], rotation_c2_from_c1[i], altitude[i]
            )
            change = true @ np.linalg.inv(moved)
        if warp:
            change = change @ _homography(
                trajectory.camera, trajectory.down_c, nominal_translation[i], nominal_rotation[i], altitude[i]
            )
        seconds.append(_normalised(images[i + 1], change))
    sequence = Sequence(
        np.stack([_normalised(image) for image in images[:-1]]),
        np.stack(seconds),
        translation,
        rotation_c2_from_c1,
        nominal_translation,
        altitude,
        trajectory.down_c,
    )
    if rng is not None:
        sequence = mirrored(sequence, trajectory.camera, rng)
    return replace(sequence, flow_px=_residual_flow(sequence, trajectory.camera)) if warp else sequence


def mirrored(sequence: Sequence, camera: Camera, rng: np.random.Generator) -> Sequence:
    """Mirror a sequence at random: left-right, up-down and, for square images, x with y.

    A mirroring D of the image about its centre maps t to D t, the ground normal n to D n and R to D R D, with D
    extended by 1 along z. A sequence is mirrored only if its principal point is the image's centre.
    """
    flip_x, flip_y, swap = rng.random(3) < 0.5
    if (camera.cx_px, camera.cy_px) != (camera.width_px / 2, camera.height_px / 2):
        return sequence
    first, second, mirror = sequence.first, sequence.second, np.eye(3)
    if flip_x:
        first, second, mirror = first[:, :, ::-1], second[:, :, ::-1], np.diag([-1.0, 1, 1]) @ mirror
    if flip_y:
        first, second, mirror = first[:, ::-1], second[:, ::-1], np.diag([1.0, -1, 1]) @ mirror
    if swap and camera.width_px == camera.height_px and camera.fx_px == camera.fy_px:
        first, second, mirror = first.transpose(0, 2, 1), second.transpose(0, 2, 1), np.eye(3)[[1, 0, 2]] @ mirror
    return replace(
        sequence,
        first=np.ascontiguousarray(first),
        second=np.ascontiguousarray(second),
        translation_m=sequence.translation_m @ mirror.T,
        rotation_c2_from_c1=mirror @ sequence.rotation_c2_from_c1 @ mirror.T,
        nominal_translation_m=sequence.nominal_translation_m @ mirror.T,
        down_c=mirror @ sequence.down_c,
    )


def _homography(
    camera: Camera, down_c: Array, translation_m: Array, rotation_c2_from_c1: Array, altitude_m: float
) -> Array:
    return plane_homography(camera.matrix, translation_m, rotation_c2_from_c1, down_c, altitude_m)


def _residual_flow(sequence: Sequence, camera: Camera) -> Array:
    """Flow (n, height / 8, width / 8, 2), pixels, of the ground plane after the warp, at the centres of the cells."""
    height, width = sequence.first.shape[1:]
    u, v = np.meshgrid(np.arange(4, width, 8), np.arange(4, height, 8))
    centres, level, flows = np.stack([u, v], axis=-1), np.eye(3), []
    for t, r, nominal, altitude in zip(
        sequence.translation_m,
        sequence.rotation_c2_from_c1,
        sequence.nominal_translation_m,
        sequence.altitude_m,
        strict=True,
    ):
        back = np.linalg.inv(_homography(camera, sequence.down_c, nominal, level, altitude))
        moved = back @ _homography(camera, sequence.down_c, t, r, altitude)
        flows.append(apply_homography(moved, centres) - centres)
    return np.stack(flows)


def _normalised(image: np.ndarray, homography: Array | None = None) -> np.ndarray:
    """Normalise a frame (`normalised`), then resample it by a homography from output to input image."""
    values = normalised(image)
    if homography is None or np.array_equal(homography, np.eye(3)):
        return values
    return cv2.warpPerspective(
        values, pixel_index_homography(homography), image.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
