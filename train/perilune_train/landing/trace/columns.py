"""Tables and columns of a trace, with units and with the scales by which differences are divided."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

from perilune_train.landing.filter.state import N_ERRORS
from perilune_train.landing.filter.stretch import CORE

EXACT = 0.0
"""Scale of columns that must be equal."""


@dataclass(frozen=True, slots=True)
class Column:
    """Columns of a table of a trace that have one meaning."""

    names: tuple[str, ...]
    """Names of the columns."""
    unit: str
    """Unit; empty for numbers without a unit."""
    scale: float
    """Smallest scale of a value, in its unit. Differences are divided by the larger of this and the reference's
    absolute value. `EXACT` for texts and whole numbers."""
    meaning: str
    """What the columns contain."""
    variances: tuple[str, ...] = ()
    """If not empty: the columns of variances that give the scale of each column. One name: the scale is the square root
    of the reference's variance. Two names, separated by a blank: the scale of an element of a covariance is the square
    root of the product of the variances of its row and its column."""
    is_text: bool = False
    """Whether the columns are texts."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table of a trace."""

    name: str
    """Name of the file, without .parquet or .csv."""
    rows: str
    """What one row is."""
    keys: tuple[str, ...]
    """Whole-number columns that identify a row."""
    columns: tuple[Column, ...]
    """The other columns."""

    def flat(self) -> dict[str, tuple[Column, str]]:
        """Each column except the keys by name, with its description and its variances."""
        return {
            name: (column, variance)
            for column in self.columns
            for name, variance in zip(column.names, column.variances or [""] * len(column.names), strict=True)
        }


def covariance_names(prefix: str, n: int) -> list[str]:
    """Names of the elements of the upper triangle of a covariance (n, n), row by row."""
    return [f"{prefix}_{i}_{j}" for i, j in combinations_with_replacement(range(n), 2)]


def _covariance(prefix: str, n: int, meaning: str) -> Column:
    names = covariance_names(prefix, n)
    places = [re.findall(r"\d+", name[len(prefix) :]) for name in names]
    variances = tuple(f"{prefix}_{i}_{i} {prefix}_{j}_{j}" for i, j in places)
    return Column(tuple(names), "", 0.0, meaning, variances)


def _axes(form: str, axes: Sequence[str] = "xyz") -> tuple[str, ...]:
    return tuple(form.format(axis) for axis in axes)


_MOTION = (
    Column(_axes("{}_m"), "m", 1.0, "position of the body, O_L"),
    Column(_axes("velocity_{}_mps"), "m/s", 1.0, "velocity, O_L"),
    Column(_axes("rotation_{}", "wxyz"), "", 1.0, "rotation_site_from_body, quaternion with w >= 0"),
    Column(_axes("gyro_bias_{}_radps"), "rad/s", 1e-4, "estimated bias of the gyroscope, O_B"),
    Column(_axes("force_bias_{}_mps2"), "m/s²", 1e-2, "estimated bias of the accelerometer, O_B"),
    Column(("ground_m",), "m", 1.0, "height of the ground below, relative to the nearest craters"),
)
STEPS = Table(
    "steps",
    "one propagation, one update between two frames, or the end of a frame",
    ("step",),
    (
        Column(("frame",), "", EXACT, "number of frames processed before this step"),
        Column(("kind",), "", EXACT, "propagate, coast, attitude, beam_range, beam_speed, range or frame", (), True),
        Column(("time_s",), "s", 1.0, "time after the step"),
        Column(("accepted",), "", EXACT, "1; 0 if the measurement was refused"),
        Column(
            _axes("innovation_{}", "012"),
            "m, m/s or rad",
            0.0,
            "measurement minus prediction; an attitude has three, a range and a speed have one, others none (NaN)",
            tuple(f"innovation_covariance_{k}_{k}" for k in range(3)),
        ),
        _covariance("innovation_covariance", 3, "covariance of the innovation, with noise; NaN without innovation"),
        *_MOTION,
        _covariance("covariance", len(CORE), "covariance of the core: errors 0 to 14, and GROUND as element 15"),
    ),
)
_POSE = "camera's position, O_L", "rotation_camera_from_site, quaternion with w >= 0"


def _pose(prefix: str, meaning: str) -> tuple[Column, Column]:
    return (
        Column(_axes(prefix + "_{}_m"), "m", 1.0, f"{meaning}: {_POSE[0]}"),
        Column(_axes(prefix + "_rotation_{}", "wxyz"), "", 1.0, f"{meaning}: {_POSE[1]}"),
    )


FRAMES = Table(
    "frames",
    "one frame",
    ("frame",),
    (
        Column(("time_s",), "s", 1.0, "time of the frame"),
        Column(("n_sightings",), "", EXACT, "number of sightings"),
        Column(("n_refused",), "", EXACT, "number of refused measurements since the previous frame"),
        Column(
            ("outcome",), "", EXACT, "no_fix, update, restart, or contradiction (a fix that was not used)", (), True
        ),
        Column(("searched",), "", EXACT, "1 if a search found the fix, 0 if not, -1 without a fix"),
        Column(("status",), "", EXACT, "status after the frame: tracking, coasting or lost", (), True),
        Column(("disagreeing",), "", EXACT, "sensors that disagree, separated by commas; or none", (), True),
        *_pose("expected", "expected pose before the frame"),
        _covariance("expected_covariance", 6, "covariance of the expected pose"),
        Column(("expected_error_px",), "px", 1.0, "standard deviation of the expected pose in the image"),
        *_pose("start", "pose from which the rounds of the fix started; NaN without a fix"),
        *_pose("fix", "pose of the fix; NaN without a fix"),
        _covariance("fix_covariance", 6, "covariance of the fix"),
        Column(("fix_nis",), "", 1.0, "normalised innovation squared of the fix against the expected pose"),
        Column(("n_matched",), "", EXACT, "number of matches of the fix"),
        Column(("rms_px",), "px", 1.0, "root mean square distance of the matches, per axis"),
        Column(("n_agreed",), "", EXACT, "number of sightings that agree with the fix"),
        Column(("n_by_chance",), "", 1.0, "mean of this number for displaced images"),
        Column(("sigma_by_chance",), "", 1.0, "standard deviation of this number for displaced images"),
        *_MOTION,
        Column(tuple(f"common_{k}_px" for k in range(5)), "px", 0.1, "image error that all sightings share"),
        Column(_axes("mounting_{}_rad"), "rad", 1e-3, "rotation of the camera from its stated mounting, O_C"),
        Column(("time_tag_s",), "s", 1e-2, "time of exposure after the frame's time"),
        Column(_axes("angular_rate_{}_radps"), "rad/s", 1e-2, "last angular rate without bias, O_B"),
        _covariance("covariance", N_ERRORS, "covariance of the 25 errors after the frame"),
    ),
)
SIGHTINGS = Table(
    "sightings",
    "one sighting",
    ("frame", "sighting"),
    (
        Column(("x_px", "y_px"), "px", 1.0, "centre in the covering pinhole image"),
        Column(("radius_px",), "px", 1.0, "radius"),
        Column(("score",), "", 1.0, "score of the detector"),
        Column(("noise_px",), "px", 0.1, "standard deviation of errors that differ from frame to frame"),
        Column(("static_px",), "px", 0.1, "standard deviation of errors that repeat in every frame of a crater"),
    ),
)
ROUNDS = Table(
    "rounds",
    "one round of a fix; after a search, of its last fit",
    ("frame", "round"),
    _pose("pose", "pose after the round"),
)
_INNOVATION = "innovation_covariance_x_x", "innovation_covariance_y_y"
MATCHES = Table(
    "matches",
    "one match of a fix",
    ("frame", "sighting"),
    (
        Column(("crater",), "", EXACT, "row of the catalogue, from 0"),
        Column(("weight",), "", 1.0, "weight of the match in the fix"),
        Column(("probability",), "", 1.0, "probability that the match is correct"),
        Column(
            ("innovation_x_px", "innovation_y_px"),
            "px",
            0.0,
            "sighting minus predicted centre; NaN if the update does not use the match",
            _INNOVATION,
        ),
        Column(
            ("innovation_covariance_x_x", "innovation_covariance_x_y", "innovation_covariance_y_y"),
            "px²",
            0.0,
            "block of the innovation covariance, with noise",
            (
                f"{_INNOVATION[0]} {_INNOVATION[0]}",
                f"{_INNOVATION[0]} {_INNOVATION[1]}",
                f"{_INNOVATION[1]} {_INNOVATION[1]}",
            ),
        ),
    ),
)
_OFFSET = "covariance_x_x", "covariance_y_y"
CRATERS = Table(
    "craters",
    "one crater in the state after a frame",
    ("frame", "crater"),
    (
        Column(("offset_x_m", "offset_y_m"), "m", 1.0, "offset of the detected centre from the catalogue's centre"),
        Column(
            ("covariance_x_x", "covariance_x_y", "covariance_y_y"),
            "m²",
            0.0,
            "covariance of the offset",
            (f"{_OFFSET[0]} {_OFFSET[0]}", f"{_OFFSET[0]} {_OFFSET[1]}", f"{_OFFSET[1]} {_OFFSET[1]}"),
        ),
    ),
)
TABLES = (STEPS, FRAMES, SIGHTINGS, ROUNDS, MATCHES, CRATERS)
