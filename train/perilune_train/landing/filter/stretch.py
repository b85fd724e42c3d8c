"""Update flights between two frames by inertial measurements, ranges, beam speeds and attitudes.

These measurements change and measure only 16 parts of the error state: the first 15 and the height of the ground (the
core). What they reveal about the other parts (craters, earlier poses) is a linear function of the core's
errors at the start of the stretch. The other parts are therefore updated once, at the end of the stretch (compressed
filter, Guivant & Nebot 2001, doi 10.1109/70.938382):

1. Every measurement changes the core, its covariance and its derivative with respect to the core at the start.
2. `range`, `line_speed` and `attitude` also keep the innovation, and its derivative with respect to the core at the
   start.
3. `states` applies all kept innovations to the other parts at once.

A filter that updates its whole covariance at every measurement gives an equal result. Here, a measurement costs only as
much as without craters. The attitudes of earlier frames differ by second-order terms, because their corrections are
summed and not applied one after the other.

All flights of a stretch have measurements at the same times, and every operation acts on all of them at once.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_train.landing.filter.propagate import Increments, InertialNoise, Moving, integrated
from perilune_train.landing.filter.state import (
    ATTITUDE,
    FORCE_BIAS,
    GROUND,
    GYRO_BIAS,
    POSITION,
    VELOCITY,
    State,
    rotation_matrices,
)
from perilune_train.landing.filter.update import gate

_INERTIAL = FORCE_BIAS.stop
_HEIGHT = _INERTIAL
"""Index of the ground's height in the core."""
CORE = np.r_[0:_INERTIAL, GROUND]
"""Indices of the core in the error state."""
DOWN = np.array([0.0, 0.0, -1.0])
"""Direction of the altimeter's beam, O_B."""
_MIN_COSINE = 0.1
"""Smallest cosine of the angle between a beam and the vertical."""
GROUND_S = 10.0
"""Correlation time of the height of the ground below a lander, seconds, at 10 to 30 m/s over ground."""
_GAP_S = 0.05
"""Shortest gap between inertial measurements that counts as missing measurements, seconds."""


RANGES, SPEEDS, ATTITUDES = "ranges", "speeds", "star tracker"
"""Kinds of measurements, as `Check` names them."""


class Check(NamedTuple):
    """How well a measurement agrees with the states of F flights."""

    sensor: str
    """Kind of the measurement."""
    time_s: float
    """Time of the measurement, seconds since the first frame."""
    squared: Array
    """Squared normalised innovations (F,); NaN without a measurement."""
    n_parts: int
    """Number of values of the measurement."""


class Recorder(Protocol):
    """Receives every step of a filter, for a trace."""

    def step(
        self, stretch: "Stretch", kind: str, innovation: Array, spread: Array, accepted: NDArray[np.bool_]
    ) -> None:
        """Receive a propagation or an update of F flights by n numbers, after it was applied.

        `innovation` (F, n) is the measurement minus its prediction, `spread` (F, n, n) its covariance, and `accepted`
        (F,) says which flights accepted it. Propagations have n = 0.
        """


class Stretch:
    """F flights from one frame to the next."""

    def __init__(
        self, states: Sequence[State], noise: InertialNoise, relief_m: float, recorder: Recorder | None = None
    ):
        """Start at the states of a frame.

        `relief_m` is the standard deviation, metres, of the ground's height, which is modelled as a Gauss-Markov
        process.
        """
        self._begin, self._noise, self._relief_m = list(states), noise, relief_m
        self._recorder = recorder
        self.time_s = states[0].time_s
        self._moving = Moving(
            np.stack([state.position_m for state in states]),
            np.stack([state.velocity_mps for state in states]),
            np.stack([state.rotation_site_from_body for state in states]),
            np.stack([state.gyro_bias_radps for state in states]),
            np.stack([state.force_bias_mps2 for state in states]),
        )
        self._ground_m = np.array([state.ground_m for state in states])
        self._covariance = np.stack([state.covariance[np.ix_(CORE, CORE)] for state in states])
        self._change = np.tile(np.eye(len(CORE)), (len(states), 1, 1))
        self._rate_radps = np.stack([state.angular_rate_radps for state in states])
        self._kept_updates: list[tuple[Array, Array]] = []
        self.n_refused = np.zeros(len(states), int)
        self.checks: list[Check] = []

    time_s: float
    """Current time, seconds since the first frame."""
    n_refused: NDArray[np.int_]
    """Number of ranges, speeds and attitudes that each flight refused (F,)."""
    checks: list[Check]
    """Innovations of all ranges, speeds and attitudes of the stretch."""

    @property
    def position_m(self) -> Array:
        """Current positions (F, 3), O_L."""
        return self._moving.position_m

    @property
    def rotation_site_from_body(self) -> Array:
        """Current attitudes (F, 3, 3)."""
        return self._moving.rotation_site_from_body

    def inertial(self, measured: Increments) -> None:
        """Propagate by inertial measurements; ignore measurements that are older or not finite."""
        measured = measured.measured()
        measured = measured.part(slice(int(np.searchsorted(measured.time_s, self.time_s, side="right")), None))
        if not len(measured):
            return
        start_s = measured.time_s - measured.interval_s
        after_s = np.concatenate([[self.time_s], measured.time_s[:-1]])
        n_done = 0
        for gap in np.flatnonzero(start_s > after_s + _GAP_S):
            self._propagate(measured.part(slice(n_done, gap)))
            self.coast(float(start_s[gap]))
            n_done = int(gap)
        self._propagate(measured.part(slice(n_done, None)))

    def _propagate(self, measured: Increments) -> None:
        """Propagate by consecutive measurements; each begins where the previous one ends."""
        if not len(measured):
            return
        measured = replace(measured, interval_s=np.diff(measured.time_s, prepend=self.time_s))
        motion = integrated(self._moving, measured, self._noise)
        self._moving = motion.end
        self._rate_radps = np.broadcast_to(
            measured.angular_rate_radps[..., -1, :] - self._moving.gyro_bias_radps, self._rate_radps.shape
        )
        kept = np.exp(-(measured.time_s[-1] - self.time_s) / GROUND_S)
        self._ground_m = kept * self._ground_m
        self._moved(float(measured.time_s[-1]), motion.change, motion.added, kept)
        self._record("propagate")

    def coast(self, until_s: float) -> None:
        """Propagate without inertial measurements, at constant velocity and attitude.

        The uncertainty of both grows.
        """
        gap_s = until_s - self.time_s
        self._moving = replace(self._moving, position_m=self.position_m + self._moving.velocity_mps * gap_s)
        change = np.eye(_INERTIAL)
        change[POSITION, VELOCITY] = gap_s * np.eye(3)
        speed_mps = self._noise.coast_mps2 * gap_s
        sigmas = np.repeat([speed_mps * gap_s / 2, speed_mps, self._noise.coast_radps * gap_s, 0.0, 0.0], 3)
        self._moved(until_s, change, np.diag(sigmas**2), 1.0)
        self._record("coast")

    def _moved(self, time_s: float, change: Array, added: Array, kept: float) -> None:
        """Apply the transition matrix `change` and the process noise `added` of the first 15 errors.

        `kept` is the share of the ground's height error that remains.
        """
        whole, noise = np.zeros_like(self._covariance), np.zeros_like(self._covariance)
        whole[:, :_INERTIAL, :_INERTIAL], whole[:, _HEIGHT, _HEIGHT] = change, kept
        noise[:, :_INERTIAL, :_INERTIAL], noise[:, _HEIGHT, _HEIGHT] = added, self._relief_m**2 * (1 - kept**2)
        self._covariance = whole @ self._covariance @ np.swapaxes(whole, 1, 2) + noise
        self._change = whole @ self._change
        self.time_s = time_s

    def range(
        self, range_m: float | Array, ground_m: Array, sigma_m: float, beam_in_body: Array = DOWN
    ) -> NDArray[np.bool_]:
        """Update by a range to the ground along a beam; returns whether each flight accepted the range (F,).

        `range_m` is one range for all flights, or one for each (F,); NaN where it is missing. `beam_in_body` (3,) is
        the beam's direction. `ground_m` (F,) are the heights of the ground at the craters nearest to the beam's end;
        `sigma_m` is the standard deviation of the range, metres. A flight whose beam does not point down refuses the
        range.
        """
        rotation, height_m = self._moving.rotation_site_from_body, self.position_m[:, 2] - ground_m - self._ground_m
        cosine = -(rotation[:, 2] @ beam_in_body)
        points_down = cosine > _MIN_COSINE
        cosine = np.where(points_down, cosine, 1.0)
        by_error = np.zeros((len(cosine), len(CORE)))
        by_error[:, 2], by_error[:, _HEIGHT] = 1 / cosine, -1 / cosine
        by_error[:, ATTITUDE] = (height_m / cosine**2)[:, None] * np.cross(beam_in_body, rotation[:, 2])
        kind = "range" if beam_in_body is DOWN else "beam_range"
        return self._update(kind, range_m - height_m / cosine, by_error, sigma_m, points_down)

    def line_speed(self, speed_mps: float | Array, sigma_mps: float, beam_in_body: Array) -> NDArray[np.bool_]:
        """Update by the speed over ground along a beam; returns whether each flight accepted the speed (F,).

        The speed is the component of the velocity along `beam_in_body` (3,), positive towards the beam's end; one for
        all flights, or one for each (F,); NaN where it is missing.
        """
        rotation, velocity = self._moving.rotation_site_from_body, self._moving.velocity_mps
        in_body = (velocity[:, None] @ rotation)[:, 0]
        by_error = np.zeros((len(rotation), len(CORE)))
        by_error[:, VELOCITY], by_error[:, ATTITUDE] = rotation @ beam_in_body, np.cross(beam_in_body, in_body)
        return self._update("beam_speed", speed_mps - in_body @ beam_in_body, by_error, sigma_mps)

    def attitude(self, rotation_site_from_body: Array, sigmas_rad: Array) -> NDArray[np.bool_]:
        """Update by a measured attitude; returns whether each flight accepted the attitude (F,).

        The attitude is one for all flights (3, 3), or one for each (F, 3, 3). `sigmas_rad` (3,) are the standard
        deviations about the body's axes, radians. An attitude that is not finite is ignored.
        """
        own = self._moving.rotation_site_from_body
        measured = np.broadcast_to(np.isfinite(rotation_site_from_body).all(axis=(-2, -1)), len(own))
        if not measured.any():
            return np.zeros(len(own), bool)
        rotation_site_from_body = np.where(measured[:, None, None], rotation_site_from_body, own)
        spread = self._covariance[:, ATTITUDE, ATTITUDE] + np.diag(sigmas_rad**2)
        turn = innovation = self._turn_to(rotation_site_from_body)
        # Rotation vectors are unreliable near half a turn. Refuse turns above 90 degrees: their trace is below 1.
        is_near = (self._moving.rotation_site_from_body * rotation_site_from_body).sum(axis=(1, 2)) > 1
        squared = (turn * np.linalg.solve(spread, turn[:, :, None])[:, :, 0]).sum(axis=1)
        squared = np.where(is_near, squared, np.inf)
        accepted = measured & (squared <= gate(3))
        self.checks.append(Check(ATTITUDES, self.time_s, np.where(measured, squared, np.nan), 3))
        for axis, sigma_rad in enumerate(sigmas_rad):
            by_error = np.zeros((len(turn), len(CORE)))
            by_error[:, ATTITUDE.start + axis] = 1
            # The updates about earlier axes have changed the attitude.
            turn = self._turn_to(rotation_site_from_body)
            self._apply(turn[:, axis], by_error, float(sigma_rad), accepted)
        self.n_refused += measured & ~accepted
        self._record("attitude", innovation, spread, accepted)
        return accepted

    def _turn_to(self, rotation_site_from_body: Array) -> Array:
        """Rotation vectors (F, 3), O_B, from the attitudes to other attitudes."""
        return rotation_vectors(np.swapaxes(self._moving.rotation_site_from_body, 1, 2) @ rotation_site_from_body)

    def _update(
        self, kind: str, innovation: Array, by_error: Array, sigma: float, is_possible: NDArray[np.bool_] | bool = True
    ) -> NDArray[np.bool_]:
        """Update the flights in which one number passes the gate; returns whether it passes (F,).

        Flights in which the innovation is not finite have no measurement.
        """
        measured = np.isfinite(innovation)
        innovation = np.where(measured, innovation, 0.0)
        spread = (by_error * (self._covariance @ by_error[:, :, None])[:, :, 0]).sum(axis=1) + sigma**2
        squared = np.where(is_possible, innovation**2 / spread, np.inf)
        accepted = measured & (squared <= gate(1))
        sensor = SPEEDS if kind == "beam_speed" else RANGES
        self.checks.append(Check(sensor, self.time_s, np.where(measured, squared, np.nan), 1))
        self._apply(innovation, by_error, sigma, accepted)
        self.n_refused += measured & ~accepted
        if measured.any():
            self._record(kind, innovation[:, None], spread[:, None, None], accepted)
        return accepted

    def _record(
        self,
        kind: str,
        innovation: Array | None = None,
        spread: Array | None = None,
        accepted: NDArray[np.bool_] | None = None,
    ) -> None:
        """Report a step to the recorder, if there is one."""
        if self._recorder is not None:
            n = len(self._begin)
            innovation = np.zeros((n, 0)) if innovation is None else innovation
            spread = np.zeros((n, 0, 0)) if spread is None else spread
            self._recorder.step(self, kind, innovation, spread, np.ones(n, bool) if accepted is None else accepted)

    def _apply(self, innovation: Array, by_error: Array, sigma: float, accepted: NDArray[np.bool_]) -> None:
        """Update the flights that accept one number.

        `innovation` (F,) is the measured minus the expected number, `by_error` (F, 16) its derivative with respect to
        the core, and `sigma` its standard deviation.
        """
        crossed = (self._covariance @ by_error[:, :, None])[:, :, 0]
        spread = (by_error * crossed).sum(axis=1) + sigma**2
        # Divide by the innovation's standard deviation; a scale of 0 leaves out flights that refuse the number.
        scale = accepted / np.sqrt(spread)
        innovation, crossed, by_error = innovation * scale, crossed * scale[:, None], by_error * scale[:, None]
        by_start = (by_error[:, None] @ self._change)[:, 0]
        self._kept_updates.append((by_start, innovation))
        self._change = self._change - crossed[:, :, None] * by_start[:, None, :]
        self._covariance = self._covariance - crossed[:, :, None] * crossed[:, None, :]
        self._correct(crossed * innovation[:, None])

    def _correct(self, error: Array) -> None:
        """Remove estimated errors of the core (F, 16)."""
        moving = self._moving
        self._moving = Moving(
            moving.position_m + error[:, POSITION],
            moving.velocity_mps + error[:, VELOCITY],
            moving.rotation_site_from_body @ rotation_matrices(error[:, ATTITUDE]),
            moving.gyro_bias_radps + error[:, GYRO_BIAS],
            moving.force_bias_mps2 + error[:, FORCE_BIAS],
        )
        self._ground_m = self._ground_m + error[:, _HEIGHT]

    def states(self) -> list[State]:
        """The states at the current time."""
        if not self._kept_updates and self.time_s == self._begin[0].time_s:
            return self._begin
        return [self._state(number) for number in range(len(self._begin))]

    def _state(self, number: int) -> State:
        before, moving, change = self._begin[number], self._moving, self._change[number]
        from_core = before.covariance[:, CORE]
        covariance, error = before.covariance.copy(), np.zeros(len(before.covariance))
        if self._kept_updates:
            crossed = from_core @ np.stack([derivative[number] for derivative, _ in self._kept_updates], axis=1)
            covariance -= crossed @ crossed.T
            error = crossed @ np.array([innovation[number] for _, innovation in self._kept_updates])
        from_core = from_core @ change.T
        covariance[:, CORE], covariance[CORE] = from_core, from_core.T
        core = self._covariance[number]
        covariance[np.ix_(CORE, CORE)] = (core + core.T) / 2
        return replace(
            before.corrected(error, covariance),
            time_s=self.time_s,
            position_m=moving.position_m[number],
            velocity_mps=moving.velocity_mps[number],
            rotation_site_from_body=moving.rotation_site_from_body[number],
            gyro_bias_radps=moving.gyro_bias_radps[number],
            force_bias_mps2=moving.force_bias_mps2[number],
            ground_m=float(self._ground_m[number]),
            angular_rate_radps=self._rate_radps[number],
        )
