"""Check that the files of a descent use one clock."""

from pathlib import Path

import numpy as np

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_train.landing.filter.flight import Instruments
from perilune_train.landing.fly.tables import unit_of

_LEAST_SHARE = 0.01
"""Share of the time of the frames that inertial measurements must cover."""


def check_clocks(frames: Path, frame_time_s: Array, imu: Path, ranges: Path | None, instruments: Instruments) -> None:
    """Raises UserError if inertial measurements or ranges are not from the time of the frames."""
    inertial = instruments.inertial
    start_s, end_s = float(frame_time_s[0]), float(frame_time_s[-1])
    if end_s <= start_s:
        return
    first_s, last_s = float(inertial.time_s[0] - inertial.interval_s[0]), float(inertial.time_s[-1])
    covered_s = min(last_s, end_s) - max(first_s, start_s)
    if covered_s <= _LEAST_SHARE * (end_s - start_s):
        raise _other_clock(imu, (first_s, last_s), frames, (start_s, end_s))
    time_s = instruments.range_time_s
    if ranges is None or not len(time_s):
        return
    inside = (time_s >= start_s) & (time_s <= end_s)
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    if not inside.any() or step_s > end_s - start_s:
        raise _other_clock(ranges, (float(time_s[0]), float(time_s[-1])), frames, (start_s, end_s))


def _other_clock(path: Path, own_s: tuple[float, float], frames: Path, frames_s: tuple[float, float]) -> UserError:
    """The error about two ranges of time, with the unit or the offset that would explain them."""
    own, others = own_s[1] - own_s[0], frames_s[1] - frames_s[0]
    expected = f"the clock of {frames}, {_text(frames_s[0])} to {_text(frames_s[1])} s"
    if own > 0 and (unit := unit_of(own / others)) is not None:
        expected += f"; these may be {unit[0]}: divide by {unit[1]:g}"
    elif own > 0 and (unit := unit_of(others / own)) is not None:
        expected += f"; those of the frames may be {unit[0]}: divide them by {unit[1]:g}"
    else:
        expected += f"; the starts differ by {_text(own_s[0] - frames_s[0])} s"
    return UserError(path, "time_s", f"{_text(own_s[0])} to {_text(own_s[1])} s", expected)


def _text(time_s: float) -> str:
    return np.format_float_positional(round(time_s, 6), trim="-")
