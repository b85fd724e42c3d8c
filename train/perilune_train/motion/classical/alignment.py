"""Direct alignment of two frames: fit motion, tilt and ground heights so that the second frame matches the first.

The unknowns, in this order, are turn (3) and shift (3) of the points of frame 2, tilt of frame 1 (2), and heights at
the nodes of a grid over the ground (25). Steps for each level of an image pyramid, coarsest first:

1. Project the pixels of frame 1 onto the ground and into frame 2 (`ContrastResiduals`).
2. Compare local contrast (contrast.py), with Tukey's weights (Beaton & Tukey 1974, doi
   10.1080/00401706.1974.10489171).
3. Take a Gauss-Newton step, with a prior of motion, tilt and heights (`align`).

Sources: Lucas & Kanade 1981; for free heights, direct odometry (Engel et al. 2018, doi 10.1109/TPAMI.2017.2658577).
Along a trajectory, each pair starts from KLT's motion and the heights of the previous pair (`aligned_trajectory`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector, rotation_vectors
from perilune_train.motion.classical.contrast import Level, local_contrast, pyramid, sampled
from perilune_train.motion.classical.estimate import EstimatedMotion, ExpectedMotion, GroundPlane
from perilune_train.motion.classical.ground import N_NODES, Heights, carried, node_weights, unknown_heights
from perilune_train.motion.classical.klt import NOMINAL_TURN_SIGMA_RAD, SHIFT_SHARE, klt_motion, stretched
from perilune_train.motion.data.gyroscope import GyroscopeTurns
from perilune_train.motion.data.trajectories import Trajectory

TUKEY = 4.685
DEPENDENT_PIXELS = 6.0
"""Number of pixels that together count as one independent pixel, because errors of neighbouring pixels are correlated.
Chosen on training and validation scenes."""
_TILT_SIGMA_RAD = float(np.radians(0.5))
"""Standard deviation of the tilt from a level attitude, about each axis, radians."""
_ITERATIONS = 8
_SMALL_STEP = 1e-5
"""The iteration ends when the steps of the turn (radians) and of shift / altitude are smaller than this."""
MARGIN_PX = 2
_N_POSE = 8
_N_UNKNOWN = _N_POSE + N_NODES
_LEVELS = 2


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known about a pair of frames before the alignment."""

    motion: ExpectedMotion
    """Expected motion."""
    plane: GroundPlane
    """The ground plane below the camera of frame 1, if this camera is level."""
    heights: Heights
    """Heights of the ground that frame 1 shows."""

    def precision(self) -> Array:
        """Inverse covariance (n_unknown, n_unknown) of the unknowns before the alignment."""
        precision = np.zeros((_N_UNKNOWN, _N_UNKNOWN))
        shift_sigma_m = SHIFT_SHARE * self.plane.altitude_m
        sigmas = [self.motion.turn_sigma_rad] * 3 + [shift_sigma_m] * 3 + [_TILT_SIGMA_RAD] * 2
        precision[range(_N_POSE), range(_N_POSE)] = 1 / np.square(sigmas)
        precision[_N_POSE:, _N_POSE:] = np.linalg.inv(self.heights.covariance_m2)
        return precision


@dataclass(frozen=True, slots=True)
class State:
    """The unknowns of a pair of frames."""

    translation_m: Array
    """Motion (3,), O_C of frame 1."""
    rotation_c2_from_c1: Array
    """Rotation (3, 3)."""
    tilt_rad: Array
    """Tilt of frame 1 (2,) about the axes of `tilt_axes`."""
    height_m: Array
    """Heights at the nodes (N_NODES,)."""

    def changed(self, step: Array) -> "State":
        """Return the state after a step (n_unknown,) of the unknowns."""
        # X2' = T (R (X1 - t)) + s = T R (X1 - t'), with t' = t - (T R)^T s.
        rotation_c2_from_c1 = matrix_from_rotation_vector(step[:3]) @ self.rotation_c2_from_c1
        translation = self.translation_m - rotation_c2_from_c1.T @ step[3:6]
        return State(translation, rotation_c2_from_c1, self.tilt_rad + step[6:_N_POSE], self.height_m + step[_N_POSE:])

    def offset(self, prior: Prior) -> Array:
        """Difference (n_unknown,) between the unknowns and their prior means."""
        turn = rotation_vectors(self.rotation_c2_from_c1 @ prior.motion.rotation_c2_from_c1.T)
        shift = self.rotation_c2_from_c1 @ (prior.motion.translation_m - self.translation_m)
        return np.concatenate([turn, shift, self.tilt_rad, self.height_m - prior.heights.mean_m])

    def down_c(self, prior: Prior) -> Array:
        """Unit vector (3,) towards the ground in O_C of frame 1."""
        level = prior.plane.down_c
        down = level + self.tilt_rad @ tilt_axes(level)
        return down / np.linalg.norm(down)


class Residuals(Protocol):
    """Differences between two images of one level, as a function of the state."""

    def normal_equations(self, state: State) -> tuple[Array, Array]:
        """Weighted normal matrix (n_unknown, n_unknown) and gradient (n_unknown,) of the squared differences."""


class ContrastResiduals:
    """Differences of local contrast."""

    def __init__(self, first: Level, second: Level, prior: Prior):
        inner = np.s_[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
        pixels = first.camera.pixel_centres()[inner].reshape(-1, 2)
        self._prior, self._camera = prior, second.camera
        self._values = first.contrast[inner].ravel()
        self._rays = first.camera.rays(pixels).astype(np.float32)
        self._nodes = node_weights(first.camera, pixels)
        by_row, by_column = np.gradient(second.contrast)
        self._maps = np.stack([second.contrast, by_column, by_row])

    def normal_equations(self, state: State) -> tuple[Array, Array]:
        """Weighted normal matrix (n_unknown, n_unknown) and gradient (n_unknown,) of the squared differences."""
        down = state.down_c(self._prior).astype(np.float32)
        along = self._rays @ down
        drop_m = self._prior.plane.altitude_m - self._nodes @ state.height_m.astype(np.float32)
        points = self._rays * (drop_m / along)[:, None]
        rotation_c2_from_c1 = state.rotation_c2_from_c1.astype(np.float32)
        moved = (points - state.translation_m.astype(np.float32)) @ rotation_c2_from_c1.T
        value, by_u, by_v = sampled(self._maps, self._camera.project(moved))
        used = np.isfinite(value)
        error = np.where(used, value - self._values, 0)
        by_moved = _by_point(np.nan_to_num(by_u), np.nan_to_num(by_v), moved, self._camera)
        spread = 1.4826 * float(np.median(np.abs(error[used]))) + 1e-6 if used.any() else 1.0
        weight = np.where(used, np.clip(1 - (error / (TUKEY * spread)) ** 2, 0, None) ** 2, 0)
        weight /= spread**2 * DEPENDENT_PIXELS
        jacobian = self._jacobian(points, moved, along, by_moved, by_moved @ rotation_c2_from_c1)
        scaled = jacobian * weight[:, None].astype(np.float32)
        return (scaled.T @ jacobian).astype(np.float64), (scaled.T @ error).astype(np.float64)

    def _jacobian(self, points: Array, moved: Array, along: Array, by_moved: Array, by_first: Array) -> Array:
        """Derivatives (n, n_unknown) of the differences with respect to the unknowns.

        They are computed from the derivatives (n, 3) with respect to the points of frame 2 and of frame 1.
        """
        jacobian: NDArray[Any] = np.empty((len(points), _N_UNKNOWN), np.float32)
        # A turn w from the left moves a point X by w x X, so it changes the value by w . (X x derivative).
        jacobian[:, :3], jacobian[:, 3:6] = np.cross(moved, by_moved), by_moved
        tilted = self._rays @ tilt_axes(self._prior.plane.down_c).T.astype(np.float32)
        jacobian[:, 6:_N_POSE] = -(np.einsum("ni,ni->n", by_first, points) / along)[:, None] * tilted
        jacobian[:, _N_POSE:] = self._nodes * (-np.einsum("ni,ni->n", by_first, self._rays) / along)[:, None]
        return jacobian


def align(
    first: list[Level],
    second: list[Level],
    prior: Prior,
    start: State,
    residuals_of: Callable[[Level, Level, Prior], Residuals] = ContrastResiduals,
) -> tuple[State, Array]:
    """Align two pyramids, coarsest level first; return the state and its covariance (n_unknown, n_unknown).

    Turns multiply from the left and are in radians. Shifts are in metres, O_C of frame 2.
    """
    precision, state = prior.precision(), start
    for coarse_first, coarse_second in zip(first, second, strict=True):
        residuals = residuals_of(coarse_first, coarse_second, prior)
        for _ in range(_ITERATIONS):
            normal, gradient = residuals.normal_equations(state)
            normal, gradient = normal + precision, gradient + precision @ state.offset(prior)
            # Metres and radians have very different scales; a unit diagonal keeps the system well conditioned.
            unit: Array = 1 / np.sqrt(np.diag(normal))
            scale: Array = unit[:, None] * unit
            covariance = scale * np.linalg.inv(scale * normal)
            step = -covariance @ gradient
            state = state.changed(step)
            if np.abs(step[:6] / np.repeat([1, prior.plane.altitude_m], 3)).max() < _SMALL_STEP:
                break
    return state, covariance


def _by_point(by_u: Array, by_v: Array, points: Array, camera: Camera) -> Array:
    """Derivatives (n, 3) with respect to points (n, 3), O_C, from the derivatives with respect to image coordinates."""
    x, y, z = points.T
    by_x, by_y = by_u * np.float32(camera.fx_px) / z, by_v * np.float32(camera.fy_px) / z
    return np.stack([by_x, by_y, -(by_x * x + by_y * y) / z], axis=1)


def tilt_axes(down_c: Array) -> Array:
    """Two unit vectors (2, 3) perpendicular to a direction and to each other."""
    first = np.cross(down_c, np.eye(3)[np.argmin(np.abs(down_c))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(down_c, first)])


def aligned_trajectory(
    trajectory: Trajectory,
    turns: GyroscopeTurns | None = None,
    contrast: Callable[[np.ndarray], Any] = local_contrast,
    fit: Callable[[list[Level], list[Level], Prior, State], tuple[State, Array]] = align,
) -> EstimatedMotion:
    """Estimate the motions of a whole trajectory from images and, if given, a gyroscope.

    The altitude of the first frame is the true one; the estimated motions then update it. `contrast` computes what
    each level of a pyramid stores from its image (`pyramid`), and `fit` aligns two pyramids (`align`).
    """
    nominal_translation, nominal_rotation_c2_from_c1 = trajectory.nominal_motion
    turn_sigma = np.full(trajectory.n_pairs, NOMINAL_TURN_SIGMA_RAD)
    if turns is not None:
        nominal_rotation_c2_from_c1, turn_sigma = turns.rotation_c2_from_c1, turns.sigma_rad
    grey = stretched(trajectory.images)
    camera, down = trajectory.camera, trajectory.down_c
    altitude_m = float(trajectory.position_m[0, 2])
    heights = unknown_heights(camera, down, altitude_m)
    first = pyramid(trajectory.images[0], camera, _LEVELS, contrast)
    motions, covariances = [], []
    for i in range(trajectory.n_pairs):
        second = pyramid(trajectory.images[i + 1], camera, _LEVELS, contrast)
        expected, plane = (
            ExpectedMotion(nominal_translation[i], nominal_rotation_c2_from_c1[i], turn_sigma[i]),
            GroundPlane(down, altitude_m),
        )
        # Give the gyroscope's rotation to KLT too, because KLT's shift compensates errors of KLT's rotation.
        tracked = klt_motion(camera, grey[i], grey[i + 1], expected, plane)
        prior = Prior(expected, plane, heights)
        start = State(tracked.translation_m, tracked.rotation_c2_from_c1, np.zeros(2), heights.mean_m)
        state, covariance = fit(first, second, prior, start)
        motion = state.translation_m, state.rotation_c2_from_c1
        down_1 = state.down_c(prior)
        lower_m = altitude_m - float(down_1 @ motion[0])
        seen = Heights(state.height_m, covariance[-N_NODES:, -N_NODES:])
        heights = carried(seen, camera, (down_1, motion[1] @ down_1), (altitude_m, lower_m), motion)
        altitude_m, first = lower_m, second
        motions.append(motion)
        covariances.append(covariance[:6, :6])
    translation, turned = (np.stack(parts) for parts in zip(*motions, strict=True))
    return EstimatedMotion((translation, turned), np.stack(covariances))
