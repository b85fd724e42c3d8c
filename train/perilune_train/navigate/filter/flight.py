"""One descent through the filter: measurements in the order of time, an estimate at every frame."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_grades import InertialGrade
from perilune_train.navigate.craters.locate import Located
from perilune_train.navigate.craters.sightings import Sightings
from perilune_train.navigate.filter.lander import Lander, Status
from perilune_train.navigate.filter.propagate import Increment
from perilune_train.navigate.filter.state import State

_SAME_S = 1e-9


@dataclass(frozen=True, slots=True)
class Instruments:
    """Measurements of one descent besides its frames."""

    inertial: list[Increment]
    """Of the inertial unit, in the order of time."""
    range_time_s: Array
    """Times of the ranges (n,), seconds since the first frame."""
    range_m: Array
    """Distances to the ground along -Z_B (n,), NaN where there is none."""

    @classmethod
    def of_trajectory(cls, dataset: Dataset, ids: tuple[str, str], grade: InertialGrade) -> "Instruments":
        """From the tables `inertial` and `ranges`, by scene_id and trajectory_id."""
        columns = ["grade", "time_s", "interval_s", "angular_rate_radps", "specific_force_mps2"]
        rows = dataset.table("inertial", columns, *ids).to_pandas()
        rows = rows[rows["grade"] == grade].sort_values("time_s")
        ranges = dataset.table("ranges", ["time_s", "range_m"], *ids).to_pandas().sort_values("time_s")
        inertial = [
            Increment(
                row.time_s, row.interval_s, np.asarray(row.angular_rate_radps), np.asarray(row.specific_force_mps2)
            )
            for row in rows.itertuples()
        ]
        return cls(inertial, ranges["time_s"].to_numpy(np.float64), ranges["range_m"].to_numpy(np.float64))


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the filter knows after a frame."""

    frame: int
    """Place of the frame in the descent."""
    state: State
    """State after the frame."""
    status: Status
    """Whether to believe it."""
    located: Located | None
    """The fix that was accepted."""


def fly(lander: Lander, instruments: Instruments, frame_time_s: Array, seen: Iterable[Sightings]) -> Iterator[Estimate]:
    """Run a filter over a descent.

    `seen` has the sightings of the frames at increasing times (n,); an iterator is advanced by one at each frame.
    Inertial measurements that are not finite are missing ones; what was measured before the lander's state is ignored.
    """
    times = np.concatenate([instruments.range_time_s, frame_time_s])
    is_frame = np.concatenate([np.zeros(len(instruments.range_time_s), bool), np.ones(len(frame_time_s), bool)])
    place = np.concatenate([np.arange(len(instruments.range_time_s)), np.arange(len(frame_time_s))])
    # At the same time, the range is first.
    order = np.lexsort([is_frame, times])
    sightings = iter(seen)
    waiting = (measured for measured in instruments.inertial if measured.is_finite)
    following = next(waiting, None)
    for k in order[times[order] >= lander.state.time_s - _SAME_S]:
        while following is not None and following.time_s <= times[k] + _SAME_S:
            lander.inertial(following)
            following = next(waiting, None)
        if times[k] > lander.state.time_s + _SAME_S:
            lander.until(times[k], following) if following is not None else lander.coast(times[k])
        if is_frame[k]:
            located = lander.sightings(next(sightings))
            yield Estimate(int(place[k]), lander.state, lander.status, located)
        else:
            lander.range(float(instruments.range_m[place[k]]))
