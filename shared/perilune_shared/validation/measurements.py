"""Check the measurements of one trajectory: the order and the times of its rows of `inertial` and `ranges`."""

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.validation.faults import Fault

_TOLERANCE_S = 1e-6


def measurement_faults(table: str, rows: pa.Table, trajectory: dict) -> Iterator[Fault]:
    """Yield the faults of the rows of `inertial` or `ranges` of a trajectory; `trajectory` is its row.

    Times must increase, for each grade, from 0 to the duration of the trajectory. The intervals of inertial
    measurements must follow each other without gaps.
    """
    where, key = f"manifest/{table}", f"{trajectory['scene_id']}/{trajectory['trajectory_id']}"
    grades = rows["grade"].unique().to_pylist() if "grade" in rows.column_names else [None]
    for grade in grades:
        own = rows if grade is None else rows.filter(pc.equal(rows["grade"], grade))
        time = own["time_s"].to_numpy()
        if (np.diff(time) <= 0).any():
            yield Fault.of(where, None, "time_s", f"not increasing in {key}", "increasing times")
        last = float(time.max())
        if last > trajectory["duration_s"] + _TOLERANCE_S:
            expected = f"at most {trajectory['duration_s']}, the duration of {key}"
            yield Fault.of(where, None, "time_s", last, expected)
        if grade is None:
            continue
        begin = np.concatenate([[0.0], time[:-1]])
        wrong = np.flatnonzero(np.abs(time - begin - own["interval_s"].to_numpy()) > _TOLERANCE_S)
        if len(wrong):
            found = f"{own['interval_s'][int(wrong[0])].as_py()} s before {time[wrong[0]]} s in {key}"
            yield Fault.of(where, None, "interval_s", found, f"{time[wrong[0]] - begin[wrong[0]]}, without a gap")
