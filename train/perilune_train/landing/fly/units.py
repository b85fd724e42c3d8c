"""Check the units of inertial measurements, and suggest units that fit better.

A reading is one interpretation of the numbers in a file of inertial measurements. Each reading is integrated from the
prior, without craters. It fits if its mean specific force is of the order of the Moon's gravity, the path stays above
the ground and below the height that thrust can reach, and the camera keeps the ground in view. A poor fit does not
prove that the units are wrong: a lander in free fall measures no specific force.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_grades import STANDARD_GRAVITY_MPS2
from perilune_train.landing.filter.propagate import Increments
from perilune_train.landing.filter.state import State

_MAX_STEPS = 400
"""Measurements are merged into at most this many steps, which are enough for a check."""
_MIN_FORCE, _MAX_FORCE = 0.3, 4.0
"""Range of the mean upward specific force of a powered descent, in units of the Moon's gravity."""
_LARGEST_RATE_RADPS = 1.0
_STEADY_RATE_RADPS = 0.03
"""Largest root mean square of the angular rate, radians per second, in a steady descent."""
_MOON_MPS2 = float(-gravity_mps2(0.0)[2])


@dataclass(frozen=True, slots=True)
class Prior:
    """The expected state at the first frame, its errors, and the geometry needed for the checks."""

    state: State
    """Expected state, at the time of the first frame."""
    position_sigma_m: float
    """Standard deviation of the expected position, metres."""
    velocity_sigma_mps: float
    """Standard deviation of the expected velocity, metres per second."""
    axis_in_body: Array
    """Direction of the camera's axis (3,), O_B."""
    end_s: float
    """Time of the last frame, seconds since the first frame."""


@dataclass(frozen=True, slots=True)
class _Reading:
    """One way to interpret the numbers in a file of inertial measurements."""

    name: str
    """Name of the reading in messages."""
    force: float = 1.0
    """Factor applied to the specific forces."""
    added_mps2: float = 0.0
    """Upward specific force that is missing from the file, metres per second^2."""
    rate: float = 1.0
    """Factor applied to the angular rates."""


@dataclass(frozen=True, slots=True)
class _Path:
    """The path that results from one reading."""

    force_mps2: float
    """Mean upward specific force, metres per second^2."""
    lowest_m: float
    """Lowest height above z = 0, metres."""
    climbs: bool
    """Whether the path ends higher than the prior allows for a descent."""
    leaves_s: float
    """Time after the first frame at which the camera's axis no longer points at the ground, or infinity."""
    rate_radps: float
    """Root mean square of the angular rate, radians per second."""
    slack_m: float
    """Largest depth below the ground, metres, at the lowest point that the prior's errors can explain."""

    @property
    def has_force(self) -> bool:
        return _MIN_FORCE <= self.force_mps2 / _MOON_MPS2 <= _MAX_FORCE

    @property
    def is_over_ground(self) -> bool:
        return self.lowest_m >= -self.slack_m and not self.climbs

    @property
    def sees_ground(self) -> bool:
        return self.leaves_s == np.inf and self.rate_radps <= _LARGEST_RATE_RADPS

    @property
    def fits(self) -> bool:
        return self.has_force and self.is_over_ground and self.sees_ground


_FORCES = (
    _Reading(""),
    _Reading("specific force in g (times 9.80665)", force=STANDARD_GRAVITY_MPS2),
    _Reading("specific force of the opposite sign", force=-1.0),
    _Reading("specific force in g and of the opposite sign", force=-STANDARD_GRAVITY_MPS2),
    _Reading(
        "the Earth's gravity in place of the Moon's (8.18 m/s2 less upwards)",
        added_mps2=_MOON_MPS2 - STANDARD_GRAVITY_MPS2,
    ),
    _Reading("accelerations without gravity (1.62 m/s2 more upwards)", added_mps2=_MOON_MPS2),
)
_RATES = (_Reading(""), _Reading("angular rates in degrees per second (times 0.0174533)", rate=np.pi / 180))


def doubts(measured: Increments, prior: Prior, *, is_lost: bool) -> list[str]:
    """Reasons to doubt the units of inertial measurements, as text; empty without doubts.

    If `is_lost`, the flight has lost its position, and less evidence is enough for a doubt.
    """
    steps = _joined(measured.measured(), prior.state.time_s, prior.end_s)
    if steps is None:
        return []
    given = _path(steps, prior, _FORCES[0])
    is_unsteady = is_lost and given.rate_radps > _STEADY_RATE_RADPS
    if given.fits and not is_unsteady:
        return []
    better = list(_better(steps, prior, is_unsteady=is_unsteady))
    if not better and given.is_over_ground and given.sees_ground and not is_lost:
        return []
    found = [
        f"mean specific force {given.force_mps2:.3g} m/s2 upwards, where the Moon's gravity is {_MOON_MPS2:.2f} m/s2"
    ]
    if given.lowest_m < -given.slack_m:
        found.append(f"the path from the prior goes {-given.lowest_m:.4g} m below the ground")
    if given.climbs:
        found.append("the path from the prior climbs")
    if given.leaves_s < np.inf:
        found.append(f"the camera turns away from the ground after {given.leaves_s:.1f} s")
    if is_unsteady or given.rate_radps > _LARGEST_RATE_RADPS:
        found.append(f"angular rates of {np.degrees(given.rate_radps):.3g} degrees per second")
    expected = f"; {' or '.join(better[:2])} would fit better" if better else "; no other unit fits"
    return ["; ".join(found) + expected]


def _better(steps: Increments, prior: Prior, *, is_unsteady: bool) -> Iterator[str]:
    """Names of the readings that fit with the fewest changes, force closest to the Moon's gravity first."""
    fitting = []
    for force, rate in product(_FORCES, _RATES):
        if not force.name and not rate.name:
            continue
        path = _path(steps, prior, replace(force, rate=rate.rate))
        if path.fits and not (is_unsteady and path.rate_radps > _STEADY_RATE_RADPS):
            changes = bool(force.name) + bool(rate.name)
            off = abs(float(np.log(path.force_mps2 / _MOON_MPS2)))
            name = " with ".join(name for name in (force.name, rate.name) if name)
            # Sort readings with added gravity last: they fit any small force.
            fitting.append((changes, force.added_mps2 > 0, off, name))
    least = min((each[0] for each in fitting), default=0)
    yield from (each[-1] for each in sorted(fitting) if each[0] == least)


def _joined(measured: Increments, start_s: float, end_s: float) -> Increments | None:
    """The measurements between two times, merged into at most `_MAX_STEPS`; None without measurements."""
    first, behind = np.searchsorted(measured.time_s, [start_s, end_s], side="right")
    if first >= behind:
        return None
    measured = measured.part(slice(int(first), int(behind)))
    starts = np.unique(np.linspace(0, len(measured), min(len(measured), _MAX_STEPS), endpoint=False).astype(int))
    weight = measured.interval_s
    total = np.add.reduceat(weight, starts)
    rate, force = (
        np.add.reduceat(values * weight[:, None], starts) / total[:, None]
        for values in (measured.angular_rate_radps, measured.specific_force_mps2)
    )
    ends = measured.time_s[np.append(starts[1:], len(measured)) - 1]
    return Increments(ends, np.diff(ends, prepend=start_s), rate, force)


def _path(steps: Increments, prior: Prior, reading: _Reading) -> _Path:
    """Integrate the measurements from the prior, as a reading interprets them."""
    position, velocity = prior.state.position_m, prior.state.velocity_mps
    rotation = prior.state.rotation_site_from_body
    up = np.array([0.0, 0.0, reading.added_mps2])
    lowest, slack, leaves_s, force_s, elapsed_s = position[2], 0.0, np.inf, 0.0, 0.0
    most_m = 3 * prior.position_sigma_m
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(len(steps)):
            step_s = float(steps.interval_s[k])
            half = matrix_from_rotation_vector(reading.rate * steps.angular_rate_radps[k] * step_s / 2)
            force = rotation @ half @ (reading.force * steps.specific_force_mps2[k]) + up
            rotation = rotation @ half @ half
            acceleration = force + gravity_mps2(position[2])
            position = position + velocity * step_s + acceleration * step_s**2 / 2
            velocity = velocity + acceleration * step_s
            force_s += float(force[2]) * step_s
            elapsed_s += step_s
            if position[2] < lowest:
                lowest, slack = float(position[2]), most_m + 3 * prior.velocity_sigma_mps * elapsed_s
            if leaves_s == np.inf and (rotation @ prior.axis_in_body)[2] >= 0:
                leaves_s = elapsed_s
    rises_m = max(float(prior.state.velocity_mps[2]), 0.0) * elapsed_s
    highest_m = prior.state.position_m[2] + rises_m + most_m + 3 * prior.velocity_sigma_mps * elapsed_s
    rate = steps.angular_rate_radps * reading.rate
    rms = float(np.sqrt(np.average((rate**2).sum(axis=1), weights=steps.interval_s)))
    # Allow for terrain: the ground is not exactly the plane z = 0.
    slack += 0.05 * float(prior.state.position_m[2])
    return _Path(force_s / elapsed_s, lowest, bool(position[2] > highest_m), leaves_s, rms, slack)
