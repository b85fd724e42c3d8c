"""State of the lander, and the error state of the filter.

Parts of the error state, in this order:

    POSITION     translation, metres, O_L                                        3
    VELOCITY     change of velocity, metres per second, O_L                      3
    ATTITUDE     rotation applied from the right, radians, O_B                   3
    GYRO_BIAS    error of the gyroscope's bias, radians per second, O_B          3
    FORCE_BIAS   error of the accelerometer's bias, metres per second^2, O_B     3
    COMMON       image error that all sightings of craters share, pixels         5
    GROUND       height of the ground below, metres                              1
    MOUNTING     rotation of the camera from its stated mounting, radians, O_C   3
    TIME_TAG     time of exposure after the frame's time tag, seconds            1
    (craters)    offset of each crater in view over ground, metres, O_L          2 each
    (poses)      translation and rotation of each kept pose, as above            6 each

Errors of the catalogue, of the detector and of the ground's height repeat from frame to frame. If the filter treated
them as noise, it would average them over frames and report too small a covariance. They are therefore parts of the
state. On request the state also keeps the poses of earlier frames. Later measurements correct these poses, which makes
the filter a smoother (stochastic cloning, Roumeliotis & Burdick 2002, doi 10.1109/ROBOT.2002.1014801).
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector, rotation_vectors
from perilune_train.compiled import compiled

POSITION, VELOCITY, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, FORCE_BIAS = slice(9, 12), slice(12, 15)
COMMON, GROUND = slice(15, 20), slice(20, 21)
MOUNTING, TIME_TAG = slice(21, 24), slice(24, 25)
CAMERA = slice(21, 25)
"""Mounting and time tag of the camera."""
N_ERRORS = 25
"""Number of elements of the error state without craters and kept poses."""

_LOW_SUN_DEG, _HIGH_SUN_DEG = 35.0, 60.0
_LOW_SUN_SIGMAS_PX = np.array([0.04, 0.04, 0.07, 0.09, 0.09])
_HIGH_SUN_SIGMAS_PX = np.array([0.07, 0.07, 0.14, 0.21, 0.21])
"""Standard deviations of the image error that all sightings share, under a low Sun (up to 35 degrees) and a high Sun
(from 60 degrees). With these values the errors of flights over the validation scenes of `shipped-nav` and over two
synthetic elevation models have the size that the filter states. Under a high Sun the detector sees rims by their albedo
and their slopes toward the Sun, and the detected centres shift more."""


def common_sigmas_px(sun_elevation_deg: float | None) -> Array:
    """Standard deviations (5,), pixels, of the image error that all sightings share.

    A high Sun is assumed if the elevation is unknown.
    """
    if sun_elevation_deg is None:
        return _HIGH_SUN_SIGMAS_PX
    high_share = np.clip((sun_elevation_deg - _LOW_SUN_DEG) / (_HIGH_SUN_DEG - _LOW_SUN_DEG), 0, 1)
    return _LOW_SUN_SIGMAS_PX + high_share * (_HIGH_SUN_SIGMAS_PX - _LOW_SUN_SIGMAS_PX)


@dataclass(frozen=True, slots=True)
class CameraErrors:
    """Expected errors of the camera before the flight."""

    sun_elevation_deg: float | None = None
    """Elevation of the Sun above the site, degrees, which sets the error that all sightings share; None if unknown."""
    mounting_sigma_deg: float = 0.0
    """Standard deviation of the camera's mounting about each axis, degrees."""
    time_tag_sigma_s: float = 0.0
    """Standard deviation of the constant difference between exposure and time tag, seconds."""


EXACT_CAMERA = CameraErrors()
"""A camera with exact mounting and time tags, under an unknown Sun."""


@dataclass(frozen=True, slots=True)
class State:
    """Estimate of the lander's motion, and of the errors of its sensors and its catalogue."""

    time_s: float
    """Seconds since the first frame."""
    position_m: Array
    """Position (3,), O_L."""
    velocity_mps: Array
    """Velocity (3,), O_L."""
    rotation_site_from_body: Array
    """Attitude (3, 3)."""
    gyro_bias_radps: Array
    """Bias of the gyroscope (3,), O_B."""
    force_bias_mps2: Array
    """Bias of the accelerometer (3,), O_B."""
    common_px: Array
    """Coefficients (5,), pixels, of the image error that all sightings share; see `common_pattern`."""
    ground_m: float
    """Height of the ground below, metres, relative to the median height of the nearest craters of the catalogue."""
    craters: NDArray[np.integer]
    """Craters in view (n,), as rows of the catalogue."""
    offsets_m: Array
    """Offsets (n, 2), metres, x and y in O_L, of the detected centres of these craters from the catalogue's centres."""
    covariance: Array
    """Covariance of the error state (25 + 2 n + 6 m, 25 + 2 n + 6 m)."""
    past_position_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """Positions at earlier frames (m, 3), O_L."""
    past_rotation_site_from_body: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """Attitudes at earlier frames (m, 3, 3)."""
    mounting_rad: Array = field(default_factory=lambda: np.zeros(3))
    """Rotation vector (3,), O_C, from the camera's stated mounting to the estimated mounting."""
    time_tag_s: float = 0.0
    """Estimated time of exposure after a frame's time tag, seconds."""
    angular_rate_radps: Array = field(default_factory=lambda: np.zeros(3))
    """Last measured angular rate (3,), O_B, without the estimated bias."""
    innovation_squared: float = float("nan")
    """Normalised innovation squared of the update that gave this state; NaN if the state has changed since."""
    n_innovations: int = 0
    """Number of independent parts of this innovation."""

    @classmethod
    def starting(
        cls,
        position_m: Array,
        velocity_mps: Array,
        rotation_site_from_body: Array,
        sigmas: Array,
        relief_m: float,
        camera: CameraErrors = EXACT_CAMERA,
    ) -> "State":
        """The state at the first frame.

        `sigmas` (15,) are the standard deviations of the first 15 errors; `relief_m` is the standard deviation of the
        ground's height.
        """
        none = np.zeros(3)
        of_camera = [*np.radians([camera.mounting_sigma_deg] * 3), camera.time_tag_sigma_s]
        deviations = np.concatenate([sigmas, common_sigmas_px(camera.sun_elevation_deg), [relief_m], of_camera])
        return cls(
            0.0, position_m, velocity_mps, rotation_site_from_body, none, none,
            np.zeros(5), 0.0, np.zeros(0, int), np.zeros((0, 2)), np.diag(deviations**2),
        )  # fmt: skip

    def corrected(self, error: Array, covariance: Array) -> "State":
        """Remove an estimated error (25 + 2 n + 6 m,) from the state.

        `covariance` is the new, symmetric covariance.
        """
        end = N_ERRORS + 2 * len(self.craters)
        past = error[end:].reshape(-1, 6)
        return State(
            self.time_s,
            self.position_m + error[POSITION],
            self.velocity_mps + error[VELOCITY],
            self.rotation_site_from_body @ matrix_from_rotation_vector(error[ATTITUDE]),
            self.gyro_bias_radps + error[GYRO_BIAS],
            self.force_bias_mps2 + error[FORCE_BIAS],
            self.common_px + error[COMMON],
            self.ground_m + float(error[GROUND][0]),
            self.craters,
            self.offsets_m + error[N_ERRORS:end].reshape(-1, 2),
            covariance,
            self.past_position_m + past[:, :3],
            self.past_rotation_site_from_body @ rotation_matrices(past[:, 3:]),
            self.mounting_rad + error[MOUNTING],
            self.time_tag_s + float(error[TIME_TAG][0]),
            self.angular_rate_radps,
        )

    def keeping_pose(self) -> "State":
        """The state with the current pose added to the kept poses."""
        pose = [*range(3), *range(6, 9)]
        wider = np.concatenate([np.eye(len(self.covariance)), np.eye(len(self.covariance))[pose]])
        return replace(
            self,
            covariance=wider @ self.covariance @ wider.T,
            past_position_m=np.concatenate([self.past_position_m, self.position_m[None]]),
            past_rotation_site_from_body=np.concatenate(
                [self.past_rotation_site_from_body, self.rotation_site_from_body[None]]
            ),
        )

    def with_craters(self, craters: NDArray[np.integer], sigma_m: Array) -> "State":
        """The state with the offsets of `craters` (n,) and of no other craters.

        Offsets of craters that are new to the state have standard deviations `sigma_m` (n,), metres.
        """
        row_of = np.full(1 + max(self.craters.max(initial=-1), craters.max(initial=-1)), -1)
        row_of[self.craters] = np.arange(len(self.craters))
        before = row_of[craters]
        known, new = before >= 0, np.flatnonzero(before < 0)
        rows = np.full((len(craters), 2), -1)
        rows[known] = N_ERRORS + 2 * before[known, None] + [0, 1]
        past = N_ERRORS + 2 * len(self.craters) + np.arange(6 * len(self.past_position_m))
        source = np.concatenate([np.arange(N_ERRORS), rows.ravel(), past])
        covariance = _rearranged(self.covariance, source)
        rows = (N_ERRORS + 2 * new[:, None] + [0, 1]).ravel()
        covariance[rows, rows] = np.repeat(sigma_m[new] ** 2, 2)
        offsets = np.zeros((len(craters), 2))
        offsets[known] = self.offsets_m[before[known]]
        return replace(self, craters=craters, offsets_m=offsets, covariance=covariance)

    def past_pose_error(self, number: int, position_m: Array, rotation_site_from_body: Array) -> tuple[Array, Array]:
        """Translation and rotation (6,) from a kept pose to the true pose, and their covariance (6, 6)."""
        turn = rotation_vectors(self.past_rotation_site_from_body[number].T @ rotation_site_from_body)
        start = N_ERRORS + 2 * len(self.craters) + 6 * number
        parts = slice(start, start + 6)
        return np.concatenate([position_m - self.past_position_m[number], turn]), self.covariance[parts, parts]

    def pose_error(self, position_m: Array, rotation_site_from_body: Array) -> Array:
        """Translation and rotation (6,) from the estimated pose to the true pose."""
        turn = rotation_vectors(self.rotation_site_from_body.T @ rotation_site_from_body)
        return np.concatenate([position_m - self.position_m, turn])


@compiled
def _rearranged(covariance: Array, source: NDArray[np.int64]) -> Array:
    """A covariance (n, n) whose element i is element `source[i]` of another covariance.

    Elements with source -1 have zero covariance.
    """
    rearranged = np.zeros((len(source), len(source)))
    for i in range(len(source)):
        if source[i] < 0:
            continue
        for j in range(len(source)):
            if source[j] >= 0:
                rearranged[i, j] = covariance[source[i], source[j]]
    return rearranged


_CROSS = np.zeros((3, 9))
_CROSS[[0, 0, 1, 1, 2, 2], [5, 7, 2, 6, 1, 3]] = -1, 1, 1, -1, -1, 1
"""The matrix of the cross product with each axis, row by row."""


def cross_matrices(vectors: Array) -> Array:
    """Matrices (..., 3, 3) whose products with u are the cross products v x u, for vectors v (..., 3)."""
    return (vectors @ _CROSS).reshape(*vectors.shape, 3)


def rotation_matrices(turns_rad: Array) -> Array:
    """Rotation matrices (..., 3, 3) of many rotation vectors (..., 3), radians."""
    angle = np.sqrt((turns_rad**2).sum(axis=-1))[..., None]
    cross = cross_matrices(turns_rad / np.where(angle > 0, angle, 1.0))
    angle = angle[..., None]
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def common_pattern(ray: Array) -> Array:
    """Derivatives (n, 2, 5) of the shared image error at rays (n, 2) on the plane at depth 1.

    All sightings share this error: a shift, a scale and two terms that grow with the square of the distance from the
    image centre. Errors of position, altitude and tilt displace craters in the same pattern, so one frame cannot
    distinguish them from the image error.
    """
    x, y = ray.T
    zero, ones = np.zeros_like(x), np.ones_like(x)
    return np.stack(
        [np.stack([ones, zero, x, x**2, x * y], axis=1), np.stack([zero, ones, y, x * y, y**2], axis=1)], axis=1
    )
