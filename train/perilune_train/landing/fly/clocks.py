"""Check that the files of a descent use one clock."""

from pathlib import Path

import numpy as np

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_train.landing.filter.flight import Instruments
from perilune_train.landing.fly.tables import InstrumentFiles, unit_of

_MIN_SHARE = 0.01
"""Smallest share of the time between the first and the last frame that inertial measurements must cover."""


def check_clocks(frames: Path, frame_time_s: Array, files: InstrumentFiles, instruments: Instruments) -> None:
    """Raise UserError unless the measurements of each instrument overlap the frames in time."""
    inertial, stars, lidar = instruments.inertial, instruments.star_tracker, instruments.doppler_lidar
    start_s, end_s = float(frame_time_s[0]), float(frame_time_s[-1])
    if end_s <= start_s:
        return
    if files.imu is not None:
        first_s, last_s = float(inertial.time_s[0] - inertial.interval_s[0]), float(inertial.time_s[-1])
        covered_s = min(last_s, end_s) - max(first_s, start_s)
        if covered_s <= _MIN_SHARE * (end_s - start_s):
            raise _other_clock(files.imu, (first_s, last_s), frames, (start_s, end_s))
    others = (
        (files.ranges, instruments.range_time_s),
        (files.star_tracker, None if stars is None else stars.time_s),
        (files.doppler_lidar, None if lidar is None else np.unique(lidar.time_s)),
    )
    for path, time_s in others:
        if path is None or time_s is None or not len(time_s):
            continue
        inside = (time_s >= start_s) & (time_s <= end_s)
        step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
        if not inside.any() or step_s > end_s - start_s:
            raise _other_clock(path, (float(time_s[0]), float(time_s[-1])), frames, (start_s, end_s))


def _other_clock(
    path: Path, span_s: tuple[float, float], frames: Path, frames_span_s: tuple[float, float]
) -> UserError:
    """The error about two different time spans, with the unit or offset that may explain the difference."""
    length_s, frames_length_s = span_s[1] - span_s[0], frames_span_s[1] - frames_span_s[0]
    expected = f"the clock of {frames}, {_text(frames_span_s[0])} to {_text(frames_span_s[1])} s"
    if length_s > 0 and (unit := unit_of(length_s / frames_length_s)) is not None:
        expected += f"; these may be {unit[0]}: divide by {unit[1]:g}"
    elif length_s > 0 and (unit := unit_of(frames_length_s / length_s)) is not None:
        expected += f"; the times of the frames may be {unit[0]}: divide these by {unit[1]:g}"
    else:
        expected += f"; the starts differ by {_text(span_s[0] - frames_span_s[0])} s"
    return UserError(path, "time_s", f"{_text(span_s[0])} to {_text(span_s[1])} s", expected)


def _text(time_s: float) -> str:
    return np.format_float_positional(round(time_s, 6), trim="-")
