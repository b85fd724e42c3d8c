"""Run the filter over a descent: process measurements in time order and return an estimate at every frame."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_grades import InertialGrade
from perilune_train.landing.craters.locate import Located
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.filter.lander import Lander, Status, range_update
from perilune_train.landing.filter.propagate import Increments
from perilune_train.landing.filter.state import State
from perilune_train.landing.filter.stretch import Stretch

_SAME_S = 1e-9


@dataclass(frozen=True, slots=True)
class Instruments:
    """Measurements of one descent in addition to its frames."""

    inertial: Increments
    """Measurements of the inertial unit."""
    range_time_s: Array
    """Times of the ranges (n,), seconds since the first frame."""
    range_m: Array
    """Distances to the ground along -Z_B (n,), metres; NaN where the altimeter measured no distance."""

    @classmethod
    def of_trajectory(cls, dataset: Dataset, ids: tuple[str, str], grade: InertialGrade) -> "Instruments":
        """Read the tables `inertial` and `ranges` of a trajectory, given by scene_id and trajectory_id."""
        columns = ["grade", "time_s", "interval_s", "angular_rate_radps", "specific_force_mps2"]
        rows = dataset.table("inertial", columns, *ids).to_pandas()
        rows = rows[rows["grade"] == grade].sort_values("time_s")
        ranges = dataset.table("ranges", ["time_s", "range_m"], *ids).to_pandas().sort_values("time_s")
        rate, force = (
            np.array(rows[name].to_list(), np.float64).reshape(-1, 3)
            for name in ("angular_rate_radps", "specific_force_mps2")
        )
        time_s, interval_s = (rows[name].to_numpy(np.float64) for name in ("time_s", "interval_s"))
        inertial = Increments(time_s, interval_s, rate, force)
        return cls(inertial, ranges["time_s"].to_numpy(np.float64), ranges["range_m"].to_numpy(np.float64))


def together(flights: Sequence[Instruments]) -> Instruments:
    """Combine the instruments of F flights; times and ranges are taken from the first flight."""
    inertial = [flight.inertial for flight in flights]
    rate = np.stack([measured.angular_rate_radps for measured in inertial])
    force = np.stack([measured.specific_force_mps2 for measured in inertial])
    return replace(flights[0], inertial=replace(inertial[0], angular_rate_radps=rate, specific_force_mps2=force))


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


def fly(lander: Lander, instruments: Instruments, frame_time_s: Array, seen: Iterable[Sightings]) -> Iterator[Estimate]:
    """Run a filter over a descent.

    `seen` yields the sightings of each frame and is advanced once per frame; `frame_time_s` (n,) increases. Inertial
    measurements that are not finite count as missing. Measurements from before the lander's state are ignored.
    """
    for (estimate,) in fly_together(
        [lander], instruments, frame_time_s, ((frame_sightings,) for frame_sightings in seen)
    ):
        yield estimate


def fly_together(
    landers: Sequence[Lander], instruments: Instruments, frame_time_s: Array, seen: Iterable[Sequence[Sightings]]
) -> Iterator[list[Estimate]]:
    """Run F filters over flights with measurements at equal times; this is faster than one flight at a time.

    `seen` yields the sightings of all flights, frame by frame. The first lander sets the inertial noise, range noise
    and relief of all flights.
    """
    times = np.concatenate([instruments.range_time_s, frame_time_s])
    is_frame = np.concatenate([np.zeros(len(instruments.range_time_s), bool), np.ones(len(frame_time_s), bool)])
    number = np.concatenate([np.arange(len(instruments.range_time_s)), np.arange(len(frame_time_s))])
    # At equal times, the range comes first.
    order = np.lexsort([is_frame, times])
    sightings, surroundings = iter(seen), [lander.surroundings for lander in landers]
    measured, n_done = instruments.inertial.measured(), 0
    stretch = _stretch(landers)
    for k in order[times[order] >= stretch.time_s - _SAME_S]:
        end = int(np.searchsorted(measured.time_s, times[k] + _SAME_S, side="right"))
        stretch.inertial(measured.part(slice(n_done, end)))
        n_done = end
        if times[k] > stretch.time_s + _SAME_S:
            following = measured.part(slice(n_done, n_done + 1))
            stretch.inertial(following.until(times[k])) if len(following) else stretch.coast(times[k])
        if is_frame[k]:
            estimates, frame_sightings = [], next(sightings)
            for lander, state, frame in zip(landers, stretch.states(), frame_sightings, strict=True):
                lander.state = state
                located = lander.sightings(frame)
                estimates.append(Estimate(int(number[k]), lander.state, lander.status, located))
            yield estimates
            stretch = _stretch(landers)
        else:
            range_update(stretch, float(instruments.range_m[number[k]]), surroundings)
    for lander, state in zip(landers, stretch.states(), strict=True):
        lander.state = state


def _stretch(landers: Sequence[Lander]) -> Stretch:
    return Stretch([lander.state for lander in landers], landers[0].noise, landers[0].surroundings.relief_m)
