"""Run the filter over the measurements of a descent, with one estimate for each frame."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_grades import InertialGrade
from perilune_train.landing.craters.locate import Located
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.filter.lander import Beam, Lander, LidarErrors, Status, beam_update, range_update
from perilune_train.landing.filter.propagate import Increments
from perilune_train.landing.filter.state import State
from perilune_train.landing.filter.stretch import Stretch

_SAME_S = 1e-9
_ATTITUDE, _BEAM, _RANGE, _FRAME = range(4)
"""Kinds of measurements. Measurements with equal times are processed in this order."""


@dataclass(frozen=True, slots=True)
class StarTracker:
    """Attitudes measured by a star tracker."""

    time_s: Array
    """Times (n,), seconds since the first frame."""
    rotation_body_from_site: Array
    """Attitudes (n, 3, 3), or (F, n, 3, 3) for F flights; NaN where the tracker saw no stars."""
    sigmas_rad: Array
    """Standard deviations (3,) about the body's axes, radians."""


@dataclass(frozen=True, slots=True)
class DopplerLidar:
    """Ranges and speeds along the beams of a Doppler lidar, one row for each beam and time."""

    time_s: Array
    """Times (n,), seconds since the first frame."""
    beams: list[Beam]
    """One measurement for each time (n)."""
    errors: LidarErrors
    """Standard deviations of the measurements."""


@dataclass(frozen=True, slots=True)
class Instruments:
    """Measurements of one descent in addition to its frames."""

    inertial: Increments
    """Measurements of the inertial unit."""
    range_time_s: Array
    """Times of the ranges (n,), seconds since the first frame."""
    range_m: Array
    """Distances to the ground along -Z_B (n,), or (F, n) for F flights, metres; NaN where the altimeter measured no
    distance."""
    star_tracker: StarTracker | None = None
    """Attitudes of a star tracker; None without a star tracker."""
    doppler_lidar: DopplerLidar | None = None
    """Ranges and speeds of a Doppler lidar; None without a Doppler lidar."""

    @classmethod
    def of_trajectory(cls, dataset: Dataset, ids: tuple[str, str], grade: InertialGrade) -> "Instruments":
        """Read the ranges of a trajectory, and its inertial measurements of one grade.

        `ids` are the scene_id and the trajectory_id.
        """
        columns = ["grade", "time_s", "interval_s", "angular_rate_radps", "specific_force_mps2"]
        rows = dataset.table("inertial", columns, *ids).to_pandas()
        rows = rows[rows["grade"] == grade].sort_values("time_s")
        ranges = dataset.table("ranges", ["time_s", "range_m"], *ids).to_pandas().sort_values("time_s")
        rate, force = (_vectors(rows[name], 3) for name in ("angular_rate_radps", "specific_force_mps2"))
        time_s, interval_s = (rows[name].to_numpy(np.float64) for name in ("time_s", "interval_s"))
        inertial = Increments(time_s, interval_s, rate, force)
        return cls(inertial, ranges["time_s"].to_numpy(np.float64), ranges["range_m"].to_numpy(np.float64))


def _vectors(column: pd.Series, length: int) -> Array:
    return np.array(column.to_list(), np.float64).reshape(-1, length)


def together(flights: Sequence[Instruments]) -> Instruments:
    """Combine the measurements of F flights, which have equal times. Beams have equal directions."""
    inertial = [flight.inertial for flight in flights]
    rate = np.stack([measured.angular_rate_radps for measured in inertial])
    force = np.stack([measured.specific_force_mps2 for measured in inertial])
    first = flights[0]
    stars, lidar = first.star_tracker, first.doppler_lidar
    if stars is not None:
        attitudes = [flight.star_tracker.rotation_body_from_site for flight in flights if flight.star_tracker]
        stars = replace(stars, rotation_body_from_site=np.stack(attitudes))
    if lidar is not None:
        beams = zip(*(flight.doppler_lidar.beams for flight in flights if flight.doppler_lidar), strict=True)
        lidar = replace(lidar, beams=[_joined(of_flights) for of_flights in beams])
    return Instruments(
        replace(inertial[0], angular_rate_radps=rate, specific_force_mps2=force),
        first.range_time_s,
        np.stack([flight.range_m for flight in flights]),
        stars,
        lidar,
    )


def _joined(beams: Sequence[Beam]) -> Beam:
    """The measurements of one beam in F flights."""
    speeds, ranges = ([getattr(beam, name) for beam in beams] for name in ("speed_mps", "range_m"))
    return Beam(beams[0].direction_in_body, np.array(speeds), np.array(ranges))


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimate of the filter at one frame."""

    frame: int
    """Index of the frame in the descent."""
    state: State
    """State after the frame."""
    status: Status
    """Whether the state can be trusted."""
    located: Located | None
    """The accepted fix, if there is one."""
    n_refused: int = 0
    """Number of ranges, speeds and attitudes that were refused since the previous frame."""
    disagreeing: tuple[str, ...] = ()
    """Sensors whose measurements of the last 15 s disagree with the state more than their stated errors allow."""


def fly(lander: Lander, instruments: Instruments, frame_time_s: Array, seen: Iterable[Sightings]) -> Iterator[Estimate]:
    """Run a filter over a descent; yields one estimate for each frame.

    `frame_time_s` (n,) must increase. `seen` yields the sightings of one frame at a time. Inertial measurements that
    are not finite count as missing. Measurements older than the lander's state are ignored.
    """
    for (estimate,) in fly_together(
        [lander], instruments, frame_time_s, ((frame_sightings,) for frame_sightings in seen)
    ):
        yield estimate


def fly_together(
    landers: Sequence[Lander], instruments: Instruments, frame_time_s: Array, seen: Iterable[Sequence[Sightings]]
) -> Iterator[list[Estimate]]:
    """Run F filters at once; yields the estimates of all flights, frame by frame.

    This is faster than one flight at a time. The flights have measurements at equal times. `seen` yields the sightings
    of all flights, frame by frame. The first lander sets the inertial noise, range noise and relief of all flights.
    """
    stars, lidar = instruments.star_tracker, instruments.doppler_lidar
    none = np.zeros(0)
    of_kind = {
        _ATTITUDE: none if stars is None else stars.time_s,
        _BEAM: none if lidar is None else lidar.time_s,
        _RANGE: instruments.range_time_s,
        _FRAME: frame_time_s,
    }
    times = np.concatenate(list(of_kind.values()))
    kind = np.concatenate([np.full(len(time_s), key) for key, time_s in of_kind.items()])
    number = np.concatenate([np.arange(len(time_s)) for time_s in of_kind.values()])
    order = np.lexsort([kind, times])
    sightings, surroundings = iter(seen), [lander.surroundings for lander in landers]
    measured, n_done = instruments.inertial.measured(), 0
    stretch = _stretch(landers)
    for k in order:
        if times[k] < stretch.time_s - _SAME_S:
            if kind[k] == _FRAME:
                next(sightings)
            continue
        end = int(np.searchsorted(measured.time_s, times[k] + _SAME_S, side="right"))
        stretch.inertial(measured.part(slice(n_done, end)))
        n_done = end
        if times[k] > stretch.time_s + _SAME_S:
            following = measured.part(slice(n_done, n_done + 1))
            stretch.inertial(following.until(times[k])) if len(following) else stretch.coast(times[k])
        if kind[k] == _FRAME:
            estimates, frame_sightings = [], next(sightings)
            refused = stretch.n_refused
            for f, (lander, state, frame) in enumerate(zip(landers, stretch.states(), frame_sightings, strict=True)):
                lander.state = state
                lander.check(stretch.checks, f)
                located = lander.sightings(frame)
                known = int(number[k]), lander.state, lander.status, located, int(refused[f])
                estimates.append(Estimate(*known, lander.disagreeing))
            yield estimates
            stretch = _stretch(landers)
        elif kind[k] == _RANGE:
            range_update(stretch, instruments.range_m[..., number[k]], surroundings)
        elif kind[k] == _BEAM and lidar is not None:
            beam_update(stretch, lidar.beams[number[k]], lidar.errors, surroundings)
        elif stars is not None:
            rotation_body_from_site = stars.rotation_body_from_site[..., number[k], :, :]
            stretch.attitude(np.swapaxes(rotation_body_from_site, -1, -2), stars.sigmas_rad)
    for lander, state in zip(landers, stretch.states(), strict=True):
        lander.state = state


def _stretch(landers: Sequence[Lander]) -> Stretch:
    states, first = [lander.state for lander in landers], landers[0]
    return Stretch(states, first.noise, first.surroundings.relief_m, first.recorder)
