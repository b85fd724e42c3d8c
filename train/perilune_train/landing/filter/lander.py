"""The filter of one flight, with one method for each kind of measurement, called in time order.

inertial, coast   propagate the state
range             update the state with the distance to the ground below
beam              update the state with the range and the speed along a beam of a Doppler lidar
attitude          update the state with the attitude from a star tracker
sightings         match craters (locate.py), then one of three:
                  - the fix fits the state: update with its craters (`craters_update`)
                  - the fix and the previous fix contradict the state with an equal offset: replace position and
                    attitude (`_restart`)
                  - otherwise ignore the frame

All methods but `sightings` update a part of the state first; stretch.py updates the rest at the next frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.fix import Fix, PosePrior
from perilune_train.landing.craters.locate import Located, locate
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.filter.consistency import CRATER_FIXES, Consistency
from perilune_train.landing.filter.measurements import camera_pose, craters_update, pose_squared
from perilune_train.landing.filter.propagate import Increments, InertialNoise
from perilune_train.landing.filter.state import ATTITUDE, CAMERA, N_ERRORS, POSITION, VELOCITY, State
from perilune_train.landing.filter.stretch import DOWN, GROUND_S, Check, Stretch
from perilune_train.landing.filter.stretch import Recorder as StepRecorder
from perilune_train.landing.filter.update import gate, passes_gate

Status = Literal["tracking", "coasting", "lost"]
"""tracking: the last frame was matched to the catalogue. coasting: the last frame was not matched. lost: no frame was
matched for 15 s, a fix since the last matched frame contradicts the state, or the measurements of the last 15 s
disagree (see consistency.py)."""
RANGE_SIGMA_M, RELIEF_M = 1.0, 10.0
"""Default standard deviations, metres, of a range and of the ground's height relative to the nearest craters."""
_LOST_S = 15.0
_UNKNOWN_VELOCITY_MPS = 5.0
"""Standard deviation on each axis, metres per second, that is added to the velocity when a fix replaces a state that it
contradicts."""
_FIX_ALLOWANCE = 1.5
"""The squared normalised innovations of fixes are divided by this number in the check of consistency. Under a high Sun,
fixes share errors that their covariance lacks: over 15 s, the mean in validation flights is up to 2.5."""
_NEAREST = 10
"""The median height of this number of nearest craters is taken as the height of the ground below."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Camera, catalogue and ground of a flight."""

    camera: Camera
    """Intrinsics."""
    rotation_camera_from_body: Array
    """Mounting of the camera (3, 3)."""
    catalogue: Catalogue
    """Craters of the landing site."""
    range_sigma_m: float
    """Standard deviation of a range, metres."""
    relief_m: float
    """Standard deviation of the ground's height relative to the nearest craters, metres."""


def range_update(stretch: Stretch, range_m: float | Array, surroundings: Sequence[Surroundings]) -> NDArray[np.bool_]:
    """Update flights by one range at the current time; returns whether each flight accepted it (F,).

    `range_m` is one range for all flights, or one for each (F,). A range that is not a positive, finite length is
    refused.
    """
    return _range_along(stretch, range_m, surroundings, surroundings[0].range_sigma_m, DOWN)


def _range_along(
    stretch: Stretch, range_m: float | Array, surroundings: Sequence[Surroundings], sigma_m: float, beam_in_body: Array
) -> NDArray[np.bool_]:
    length_m = np.broadcast_to(np.asarray(range_m, float), len(surroundings))
    usable = np.isfinite(length_m) & (length_m > 0)
    if not usable.any():
        return usable
    ends = stretch.position_m
    if beam_in_body is not DOWN:
        ends = ends + np.where(usable, length_m, 0.0)[:, None] * (stretch.rotation_site_from_body @ beam_in_body)
    ground_m = np.array(
        [local.catalogue.ground_m(end, _NEAREST) for end, local in zip(ends, surroundings, strict=True)]
    )
    return stretch.range(np.where(usable, length_m, np.nan), ground_m, sigma_m, beam_in_body)


@dataclass(frozen=True, slots=True)
class Beam:
    """A measurement of one beam of a Doppler lidar."""

    direction_in_body: Array
    """Unit vector (3,), O_B, from the lander towards the ground."""
    speed_mps: float | Array
    """Speed over ground along the beam, positive towards the ground, metres per second; NaN if it is missing. An array
    (F,) holds one speed for each of F flights."""
    range_m: float | Array
    """Distance to the ground along the beam, metres; NaN if it is missing. An array (F,) holds one distance for each of
    F flights."""


@dataclass(frozen=True, slots=True)
class LidarErrors:
    """Standard deviations of a Doppler lidar."""

    speed_sigma_mps: float
    """Standard deviation of a speed, metres per second."""
    range_sigma_m: float
    """Standard deviation of a range, metres."""
    step_s: float
    """Time between two measurements of one beam, seconds."""

    def range_deviation_m(self, relief_m: float) -> float:
        """Standard deviation, metres, that the filter assumes for a range along a slanted beam.

        The ground at the end of a slanted beam differs in height from the ground below the lander, and consecutive
        ranges share this difference. The filter has no state for it. Instead it enlarges the deviation of the relief,
        so that all ranges of a beam within one correlation time together count as one.
        """
        return float(np.hypot(self.range_sigma_m, relief_m * np.sqrt(max(1.0, GROUND_S / self.step_s))))


def beam_update(stretch: Stretch, beam: Beam, errors: LidarErrors, surroundings: Sequence[Surroundings]) -> None:
    """Update flights by the range and the speed along a beam; missing values are ignored."""
    sigma_m = errors.range_deviation_m(surroundings[0].relief_m)
    _range_along(stretch, beam.range_m, surroundings, sigma_m, beam.direction_in_body)
    if np.isfinite(beam.speed_mps).any():
        stretch.line_speed(beam.speed_mps, errors.speed_sigma_mps, beam.direction_in_body)


@dataclass(frozen=True, slots=True)
class _Contradiction:
    """A fix that contradicts the state."""

    time_s: float
    """Time of the frame, seconds since the first frame."""
    offset_m: Array
    """Position of the fix minus the position in the state (3,), metres, O_L."""
    covariance: Array
    """Covariance (3, 3) of the fix's position."""

    def agrees(self, later: "_Contradiction") -> bool:
        """Whether a later fix has an equal offset, within the errors of both fixes and of the velocity."""
        step_s = later.time_s - self.time_s
        spread = self.covariance + later.covariance + np.eye(3) * (_UNKNOWN_VELOCITY_MPS * step_s) ** 2
        return passes_gate(later.offset_m - self.offset_m, spread)


class Recorder(StepRecorder, Protocol):
    """Receives every step and every frame of a filter, for a trace."""

    def frame(self, before: State, seen: Sightings, located: Located | None, lander: "Lander") -> None:
        """Receive the state before a frame, its sightings, the fix if it was accepted, and the lander after it."""


class Lander:
    """State and status of a lander; each method processes one kind of measurement.

    With `keep_poses` the state keeps the pose of every frame, and later measurements correct these poses. This makes
    the filter a smoother.
    """

    def __init__(
        self,
        state: State,
        noise: InertialNoise,
        around: Surroundings,
        keep_poses: bool = False,
        recorder: Recorder | None = None,
    ):
        self.status, self.recorder = "coasting", recorder
        self._keep_poses = keep_poses
        self.noise, self._around = noise, around
        self._contradiction: _Contradiction | None = None
        self._is_contradicted = False
        self._matched_s = state.time_s
        self._consistency = Consistency(state)
        self.disagreeing: tuple[str, ...] = ()
        self._state, self._since = state, None

    status: Status
    recorder: Recorder | None
    """Receives every step, for a trace; None without a trace."""
    disagreeing: tuple[str, ...]
    """Sensors whose measurements of the last 15 s disagree with the state more than their stated errors allow."""
    noise: InertialNoise
    """Noise of the inertial unit."""
    _since: Stretch | None
    """Effect of the measurements since `_state`; None if there are no such measurements."""

    @property
    def surroundings(self) -> Surroundings:
        """Camera, catalogue and ground of the flight."""
        return self._around

    @property
    def state(self) -> State:
        """The state at the current time."""
        if self._since is not None:
            self.check(self._since.checks)
            (self.state,) = self._since.states()
        return self._state

    @state.setter
    def state(self, state: State) -> None:
        self._state, self._since = state, None

    @property
    def _stretch(self) -> Stretch:
        if self._since is None:
            self._since = Stretch([self._state], self.noise, self._around.relief_m, self.recorder)
        return self._since

    def inertial(self, measured: Increments) -> None:
        """Propagate by inertial measurements; ignore measurements that are not finite or older than the state."""
        self._stretch.inertial(measured)

    def coast(self, until_s: float) -> None:
        """Propagate without inertial measurements, at constant velocity and attitude."""
        self._stretch.coast(until_s)

    def range(self, range_m: float) -> bool:
        """Update by a range at the current time; returns whether it was accepted.

        A range that is not a positive, finite length is refused.
        """
        return bool(range_update(self._stretch, range_m, [self._around])[0])

    def beam(self, beam: Beam, errors: LidarErrors) -> None:
        """Update by the range and the speed along a beam at the current time."""
        beam_update(self._stretch, beam, errors, [self._around])

    def attitude(self, rotation_site_from_body: Array, sigmas_rad: Array) -> bool:
        """Update by an attitude (3, 3) at the current time; returns whether it was accepted.

        `sigmas_rad` (3,) are the standard deviations about the body's axes, radians.
        """
        return bool(self._stretch.attitude(rotation_site_from_body, sigmas_rad)[0])

    def check(self, checks: Sequence[Check], number: int = 0) -> None:
        """Record how well measurements before the next frame agree; the lander is flight `number` of the checks."""
        for check in checks:
            if not np.isnan(check.squared[number]):
                self._consistency.add(check.sensor, check.time_s, float(check.squared[number]), check.n_parts)

    def sightings(self, seen: Sightings) -> Located | None:
        """Update by the craters of a frame at the current time; returns the fix if it was accepted."""
        before = self.state
        located = self._matched(seen)
        self.disagreeing = self._consistency.disagreeing(self.state)
        if self.disagreeing:
            self.status = "lost"
        if self.recorder is not None:
            self.recorder.frame(before, seen, located, self)
        if self._keep_poses:
            self.state = self.state.keeping_pose()
        return located

    def _matched(self, sightings: Sightings) -> Located | None:
        located = locate(sightings, self._around.catalogue, self._around.camera, self._expected())
        if located is None:
            self._unmatched()
            return None
        fix, rotation_camera_from_body = located.fix, self._around.rotation_camera_from_body
        squared = pose_squared(self.state, fix.pose, fix.covariance, rotation_camera_from_body)
        self._consistency.add(CRATER_FIXES, self.state.time_s, squared / _FIX_ALLOWANCE, 6)
        if squared > gate(6):
            if not self._replaces(fix):
                self._is_contradicted = True
                self._unmatched()
                return None
            self._restart(located)
        else:
            local = self._around
            self.state = craters_update(
                self.state, fix, sightings, local.catalogue, local.camera, rotation_camera_from_body
            )
        self._contradiction, self._is_contradicted = None, False
        self._matched_s, self.status = self.state.time_s, "tracking"
        return located

    def _replaces(self, fix: Fix) -> bool:
        """Whether a fix that contradicts the state replaces it: only if the previous fix had an equal offset.

        A fix whose attitude contradicts the state is wrong, because the attitude from a gyroscope does not jump. This
        does not hold if no frame was matched for `_LOST_S`.
        """
        expected, state = self._expected(), self.state
        turn = rotation_vectors(fix.pose.rotation_camera_from_site @ expected.pose.rotation_camera_from_site.T)
        if not self._late and not passes_gate(turn, fix.covariance[3:, 3:] + expected.covariance[3:, 3:]):
            return False
        before = self._contradiction
        offset_m = fix.pose.position_m - state.position_m
        self._contradiction = _Contradiction(state.time_s, offset_m, fix.covariance[:3, :3])
        return before is not None and before.agrees(self._contradiction)

    @property
    def _late(self) -> bool:
        return self.state.time_s - self._matched_s > _LOST_S

    def _unmatched(self) -> None:
        self.status = "lost" if self._late or self._is_contradicted else "coasting"

    def _restart(self, located: Located) -> None:
        """Take position and attitude from a fix, and enlarge the uncertainty of the velocity."""
        fix, state = located.fix, self.state.with_craters(np.zeros(0, int), np.zeros(0))
        expected, by_error = camera_pose(state, self._around.rotation_camera_from_body)
        covariance = state.covariance.copy()
        of_camera = by_error[:, CAMERA] @ covariance[CAMERA, CAMERA] @ by_error[:, CAMERA].T
        for part in (POSITION, ATTITUDE):
            covariance[part], covariance[:, part] = 0, 0
        covariance[VELOCITY, VELOCITY] += np.eye(3) * _UNKNOWN_VELOCITY_MPS**2
        body = np.zeros((6, 6))
        body[:3, :3], body[3:, 3:] = np.eye(3), by_error[3:, ATTITUDE].T
        of_body = body @ (fix.covariance + of_camera) @ body.T
        covariance[POSITION, POSITION], covariance[ATTITUDE, ATTITUDE] = of_body[:3, :3], of_body[3:, 3:]
        covariance[POSITION, ATTITUDE], covariance[ATTITUDE, POSITION] = of_body[:3, 3:], of_body[3:, :3]
        turned = expected.rotation_camera_from_site.T @ fix.pose.rotation_camera_from_site
        self.state = replace(
            state,
            position_m=fix.pose.position_m - (expected.position_m - state.position_m),
            rotation_site_from_body=turned.T @ state.rotation_site_from_body,
            covariance=covariance,
        )

    def _expected(self) -> PosePrior:
        """The expected camera pose and the covariance (6, 6) of its error, as in `PosePrior`."""
        pose, by_error = camera_pose(self.state, self._around.rotation_camera_from_body)
        return PosePrior(pose, by_error @ self.state.covariance[:N_ERRORS, :N_ERRORS] @ by_error.T)
