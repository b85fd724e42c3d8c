"""The filter in flight: one call for each measurement, in the order of time."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_train.navigate.craters.catalogue import Catalogue
from perilune_train.navigate.craters.fix import Fix, PosePrior
from perilune_train.navigate.craters.locate import Located, locate
from perilune_train.navigate.craters.projection import Pose
from perilune_train.navigate.craters.sightings import Sightings
from perilune_train.navigate.filter.measurements import craters_update, pose_update, range_update
from perilune_train.navigate.filter.propagate import Increment, InertialNoise, propagated
from perilune_train.navigate.filter.state import ATTITUDE, POSITION, VELOCITY, State
from perilune_train.navigate.filter.update import passes_gate

Status = Literal["tracking", "coasting", "lost"]
"""tracking: the last frame was matched to craters; coasting: it was not; lost: none was for 15 s, or a fix contradicts
the state."""
RANGE_SIGMA_M, RELIEF_M = 1.0, 10.0
"""Standard deviations of a range and of the ground's height about the nearest craters, where none are given."""
_LOST_S = 15.0
_UNKNOWN_VELOCITY_MPS = 5.0
"""Standard deviation of the velocity, on each axis, where a fix contradicts the state."""
"""Fixes in a row that the gate refuses, after which the filter starts again from a fix."""
_GAP_S = 0.05
_NEAREST = 10
"""Craters whose median height is that of the ground below, but for an error of the state."""
_UNKNOWN_MPS2, _UNKNOWN_RADPS = 2.0, 0.05
"""Standard deviations of the motion while inertial measurements are missing."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What the lander knows of its camera and of the ground."""

    camera: Camera
    """Intrinsics."""
    rotation_camera_from_body: Array
    """Mounting of the camera (3, 3)."""
    catalogue: Catalogue
    """Craters of the landing site."""
    range_sigma_m: float
    """Standard deviation of a range."""
    relief_m: float
    """Standard deviation of the ground's height about that of the nearest craters."""


@dataclass(frozen=True, slots=True)
class _Contradiction:
    """A fix that contradicts the state."""

    time_s: float
    """Time of its frame."""
    offset_m: Array
    """Position by the fix less that of the state (3,), O_L."""
    covariance: Array
    """Of the position by the fix (3, 3)."""

    def agrees(self, later: "_Contradiction") -> bool:
        """Whether a later fix has the same offset, but for errors of fixes and velocity."""
        step_s = later.time_s - self.time_s
        spread = self.covariance + later.covariance + np.eye(3) * (_UNKNOWN_VELOCITY_MPS * step_s) ** 2
        return passes_gate(later.offset_m - self.offset_m, spread)


class Lander:
    """State and status of a lander; every method takes one measurement.

    With `keep_poses` the state keeps the pose of every frame, and later frames correct it: a smoother.
    """

    def __init__(self, state: State, noise: InertialNoise, around: Surroundings, keep_poses: bool = False):
        self._state, self.status = state, "coasting"
        self._keep_poses = keep_poses
        self._noise, self._around = noise, around
        self._pending: list[Increment] = []
        self._contradiction: _Contradiction | None = None
        self._matched_s = self._time_s = state.time_s

    status: Status

    @property
    def surroundings(self) -> Surroundings:
        """What the lander knows of its camera and of the ground."""
        return self._around

    @property
    def state(self) -> State:
        """The state at the present time."""
        if self._pending:
            self._state = propagated(self._state, self._pending, self._noise, self._around.relief_m)
            self._pending = []
        return self._state

    def inertial(self, measured: Increment) -> None:
        """Propagate to the end of an inertial measurement; one that is older, or not finite, is ignored."""
        self.until(measured.time_s, measured)

    def until(self, time_s: float, measured: Increment) -> None:
        """Propagate to a time within an inertial measurement."""
        if not measured.is_finite:
            return
        start_s = min(measured.time_s - measured.interval_s, time_s)
        if start_s > self._time_s + _GAP_S:
            self.coast(start_s)
        step_s = time_s - self._time_s
        if step_s > 0:
            self._pending.append(replace(measured, time_s=time_s, interval_s=step_s))
            self._time_s = time_s

    def range(self, range_m: float) -> bool:
        """Update by a range at the present time; whether it was accepted. One that is no length is not."""
        if not (np.isfinite(range_m) and range_m > 0):
            return False
        ground_m = self._around.catalogue.ground_m(self.state.position_m, _NEAREST)
        done = range_update(self.state, range_m, ground_m, self._around.range_sigma_m)
        self._state = done.state
        return done.accepted

    def sightings(self, seen: Sightings) -> Located | None:
        """Update by the craters of a frame at the present time; the fix, if one was accepted."""
        found = self._matched(seen)
        if self._keep_poses:
            self._state = self.state.keeping_pose()
        return found

    def _matched(self, seen: Sightings) -> Located | None:
        found = locate(seen, self._around.catalogue, self._around.camera, self._expected())
        if found is None:
            self._unmatched()
            return None
        fix, mounting = found.fix, self._around.rotation_camera_from_body
        pose = fix.pose.position_m, fix.pose.rotation_camera_from_site
        done = pose_update(self.state, *pose, fix.covariance, mounting)
        if not done.accepted:
            if not self._replaces(fix):
                self._unmatched()
                return None
            self._restart(found)
        else:
            around = self._around
            self._state = craters_update(self.state, fix, seen, around.catalogue, around.camera, mounting).state
        self._contradiction, self._matched_s, self.status = None, self.state.time_s, "tracking"
        return found

    def _replaces(self, fix: Fix) -> bool:
        """Whether a fix that contradicts the state shall replace it: if the fix before has the same offset.

        A fix whose attitude contradicts the state is itself wrong, since a gyroscope does not jump; but not if the
        state is lost.
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
        self.status = "lost" if self._late or self._contradiction is not None else "coasting"

    def _restart(self, found: Located) -> None:
        """Take position and attitude from a fix; the velocity becomes uncertain by what the position was wrong."""
        fix, mounting = found.fix, self._around.rotation_camera_from_body
        state = self.state.with_craters(np.zeros(0, int), np.zeros(0))
        covariance = state.covariance.copy()
        for part in (POSITION, ATTITUDE):
            covariance[part], covariance[:, part] = 0, 0
        covariance[VELOCITY, VELOCITY] += np.eye(3) * _UNKNOWN_VELOCITY_MPS**2
        body = np.zeros((6, 6))
        body[:3, :3], body[3:, 3:] = np.eye(3), -mounting.T
        own = body @ fix.covariance @ body.T
        covariance[POSITION, POSITION], covariance[ATTITUDE, ATTITUDE] = own[:3, :3], own[3:, 3:]
        covariance[POSITION, ATTITUDE], covariance[ATTITUDE, POSITION] = own[:3, 3:], own[3:, :3]
        self._state = replace(
            state,
            position_m=fix.pose.position_m,
            rotation_site_from_body=fix.pose.rotation_camera_from_site.T @ mounting,
            covariance=covariance,
        )

    def coast(self, until_s: float) -> None:
        """Go on without inertial measurements: constant velocity and attitude, with the uncertainty of both."""
        gap_s, state = until_s - self.state.time_s, self.state
        position = state.position_m + state.velocity_mps * gap_s
        change = np.eye(len(state.covariance))
        change[POSITION, VELOCITY] = gap_s * np.eye(3)
        covariance = change @ state.covariance @ change.T
        covariance[VELOCITY, VELOCITY] += np.eye(3) * (_UNKNOWN_MPS2 * gap_s) ** 2
        covariance[POSITION, POSITION] += np.eye(3) * (_UNKNOWN_MPS2 * gap_s**2 / 2) ** 2
        covariance[ATTITUDE, ATTITUDE] += np.eye(3) * (_UNKNOWN_RADPS * gap_s) ** 2
        self._state = replace(state, time_s=until_s, position_m=position, covariance=covariance)
        self._time_s = until_s

    def _expected(self) -> PosePrior:
        """The camera's expected pose, with its covariance as of a step of `Pose`."""
        mounting, state = self._around.rotation_camera_from_body, self.state
        own = [*range(3), *range(6, 9)]
        to_camera = np.zeros((6, 6))
        to_camera[:3, :3], to_camera[3:, 3:] = np.eye(3), -mounting
        covariance = to_camera @ state.covariance[np.ix_(own, own)] @ to_camera.T
        return PosePrior(Pose(state.position_m, mounting @ state.rotation_site_from_body.T), covariance)
