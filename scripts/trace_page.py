"""Write the tables of constants and columns of docs/reference/landing-filter.md from the code."""

import importlib
import re
from pathlib import Path

import numpy as np

from perilune_shared.geometry.inertial_grades import GRADES
from perilune_train.landing.filter.update import gate
from perilune_train.landing.trace.columns import TABLES, Column

PAGE = Path(__file__).parent.parent / "docs" / "reference" / "landing-filter.md"
_LANDING = "perilune_train.landing"
CONSTANTS = (
    ("perilune_shared.geometry.gravity", "MOON_GM_M3_PER_S2", "gravitational parameter, m³/s²"),
    ("perilune_shared.geometry.frames", "MOON_RADIUS_M", "radius of the Moon, m"),
    ("perilune_shared.geometry.inertial_grades", "STANDARD_GRAVITY_MPS2", "unit g of accelerometer errors, m/s²"),
    (f"{_LANDING}.filter.flight", "_SAME_S", "times that differ by less are equal, s"),
    (f"{_LANDING}.filter.stretch", "_GAP_S", "shortest gap between inertial measurements, s"),
    (f"{_LANDING}.filter.stretch", "GROUND_S", "correlation time of the height of the ground, s"),
    (f"{_LANDING}.filter.stretch", "_MIN_COSINE", "smallest cosine between a beam and the vertical"),
    (f"{_LANDING}.filter.update", "GATE_SHARE", "probability that a gate refuses a correct measurement"),
    (f"{_LANDING}.filter.lander", "_NEAREST", "craters whose median height is the ground of a range"),
    (f"{_LANDING}.filter.lander", "_LOST_S", "time without a fix until `lost`, s"),
    (f"{_LANDING}.filter.lander", "_UNKNOWN_VELOCITY_MPS", "velocity deviation added by a restart, m/s"),
    (f"{_LANDING}.filter.state", "_LOW_SUN_DEG", "elevation of a low Sun, degrees"),
    (f"{_LANDING}.filter.state", "_HIGH_SUN_DEG", "elevation of a high Sun, degrees"),
    (f"{_LANDING}.filter.state", "_LOW_SUN_SIGMAS_PX", "COMMON deviations under a low Sun, px"),
    (f"{_LANDING}.filter.state", "_HIGH_SUN_SIGMAS_PX", "COMMON deviations under a high Sun, px"),
    (f"{_LANDING}.filter.measurements", "_MIN_WEIGHT", "smallest weight of a match in an update"),
    (f"{_LANDING}.filter.measurements", "_MIN_PROBABILITY", "smallest probability of a match in an update"),
    (f"{_LANDING}.filter.lander", "_FIX_ALLOWANCE", "divisor of `fix_nis` in the check of consistency"),
    (f"{_LANDING}.filter.consistency", "WINDOW_S", "window of the check of consistency, s"),
    (f"{_LANDING}.filter.consistency", "_FALSE_ALARM_SHARE", "probability of a false alarm in a window"),
    (f"{_LANDING}.filter.consistency", "_CAMERA_FALSE_ALARM_SHARE", "smallest probability of the camera's errors"),
    (f"{_LANDING}.filter.consistency", "_START_SHARE", "factor of P0 in the check of the camera"),
    (f"{_LANDING}.filter.consistency", "_MIN_MEASUREMENTS", "smallest number of measurements that raise an alarm"),
    (
        f"{_LANDING}.craters.ambiguity",
        "_REACH_SIGMAS",
        "farthest alternative crater, deviations per axis",
    ),
    (f"{_LANDING}.craters.ambiguity", "_REACH_PX", "farthest alternative crater outside the image, px"),
    (f"{_LANDING}.craters.sightings", "MAX_SIGHTINGS", "largest number of sightings"),
    (f"{_LANDING}.craters.sightings", "_FLOOR_PX", "floor of `noise_px`, px"),
    (f"{_LANDING}.craters.sightings", "_NOISE_SHARE", "share of the radius in `noise_px`"),
    (f"{_LANDING}.craters.sightings", "STATIC_SHARE", "share of the radius in `static_px` and in a new offset"),
    (f"{_LANDING}.craters.sightings", "_PER_SCORE", "growth of log `noise_px` per unit of score"),
    (f"{_LANDING}.craters.sightings", "_USUAL_SCORE", "score without growth"),
    (f"{_LANDING}.craters.sightings", "PREDICTED_FLOOR_PX", "floor of `noise_px` with a prediction, px"),
    (f"{_LANDING}.craters.sightings", "PREDICTED_NOISE", "share of the predicted deviation in `noise_px`"),
    (f"{_LANDING}.craters.sightings", "PREDICTED_STATIC", "share of it in `static_px` and in a new offset"),
    (f"{_LANDING}.craters.sightings", "_SIZE_SHARE", "deviation of the log radius of a sighting"),
    (f"{_LANDING}.craters.locate", "NEAR_PX", "largest `expected_error_px` without a search, px"),
    (f"{_LANDING}.craters.locate", "_NEAREST", "craters whose median height is the ground of the altitude"),
    (f"{_LANDING}.craters.locate", "_NEAR_SIGMAS", "smallest support near the expected pose"),
    (f"{_LANDING}.craters.locate", "_SEARCH_SIGMAS", "smallest support after a search"),
    (f"{_LANDING}.craters.locate", "_SURE_SIGMAS", "support at which a search stops"),
    (f"{_LANDING}.craters.locate", "_AHEAD", "smallest ratio to the second-best pose of a search"),
    (f"{_LANDING}.craters.locate", "_WEAK_TILT_RAD", "rotation deviation of the weak prior, rad"),
    (f"{_LANDING}.craters.fix", "MIN_MATCHES", "smallest number of matches"),
    (f"{_LANDING}.craters.fix", "_SOFT_PX", "widths of the soft rounds, px"),
    (f"{_LANDING}.craters.fix", "_SOFT_SIGMAS", "largest distance in a soft round, deviations"),
    (f"{_LANDING}.craters.fix", "_CLUTTER_SHARE", "assumed share of false sightings"),
    (f"{_LANDING}.craters.fix", "SIZE_SPAN", "range of their log radii"),
    (f"{_LANDING}.craters.fix", "_N_HARD", "number of one-to-one rounds"),
    (f"{_LANDING}.craters.fix", "_GATE_SIGMAS", "square root of the largest cost of a pair"),
    (f"{_LANDING}.craters.fix", "_TUKEY", "limit of Tukey's weights"),
    (f"{_LANDING}.craters.fix", "_FARTHEST_PX", "margin of the reduced catalogue, px"),
    (f"{_LANDING}.craters.fix", "_SMALLER", "smallest radius of the reduced catalogue, share of the next constant"),
    (f"{_LANDING}.craters.fix", "MIN_SIZE_RATIO", "smallest radius to match, share of the smallest sighting"),
    (f"{_LANDING}.craters.fix", "COMMON_PX", "shared error added to the tilt, px"),
    (f"{_LANDING}.craters.matching", "_ALONE", "cost of an unmatched sighting"),
    (f"{_LANDING}.craters.vote", "_AGREE_SIGMAS", "largest distance of a sighting that supports a pose, deviations"),
    (f"{_LANDING}.craters.vote", "_AGREE_SIZE", "largest difference of its log radius"),
)
"""Module, name and meaning of each constant on the page."""


def constants() -> str:
    """The table of constants."""
    rows = ["| Constant | Value | Meaning |", "|---|---|---|"]
    for module, name, meaning in CONSTANTS:
        short = module.removeprefix("perilune_train.landing.").removeprefix("perilune_shared.geometry.")
        rows.append(f"| `{short}.{name}` | {_text(getattr(importlib.import_module(module), name))} | {meaning} |")
    for n in (1, 2, 3, 6):
        rows.append(f"| gate({n}) | {gate(n)!r} | largest normalised innovation squared of {n} numbers |")
    rows += ["", "| Grade | " + " | ".join(f"`{name}`" for name in _UNIT) + " |", "|---" * (len(_UNIT) + 1) + "|"]
    rows += [
        f"| `{grade}` | " + " | ".join(_text(getattr(unit, name)) for name in _UNIT) + " |"
        for grade, unit in GRADES.items()
    ]
    return "\n".join(rows)


_UNIT = (
    "gyro_bias_deg_per_h",
    "gyro_bias_walk_deg_per_h",
    "angular_random_walk_deg",
    "accelerometer_bias_mg",
    "accelerometer_bias_walk_mg",
    "velocity_random_walk_mps",
)


def tables() -> str:
    """The tables of columns."""
    parts = []
    for table in TABLES:
        keys = ", ".join(f"`{key}`" for key in table.keys)
        parts.append(f"### `{table.name}`\n\nOne row: {table.rows}. Keys: {keys}.\n")
        rows = ["| Columns | Unit | Scale | Meaning |", "|---|---|---|---|"]
        rows += [
            f"| {_names(column)} | {column.unit} | {_scale(column)} | {column.meaning} |" for column in table.columns
        ]
        parts.append("\n".join(rows) + "\n")
    return "\n".join(parts).rstrip()


def _names(column: Column) -> str:
    names = [f"`{name}`" for name in column.names]
    return ", ".join(names) if len(names) <= 6 else f"{names[0]}, {names[1]} ... {names[-1]}"


def _scale(column: Column) -> str:
    if column.is_text or (not column.scale and not column.variances):
        return "equal"
    if not column.variances:
        return f"{column.scale:g}"
    return "sqrt(C_ii C_jj)" if " " in column.variances[0] else "sqrt(variance)"


def _text(value: object) -> str:
    values = np.ravel(value).tolist()
    return ", ".join(repr(each) for each in values)


def page(text: str) -> str:
    """The page with its tables written again."""
    for name, part in (("constants", constants()), ("tables", tables())):
        pattern = rf"(<!-- {name} -->\n).*?(<!-- end -->)"
        text = re.sub(pattern, lambda found, part=part: f"{found[1]}\n{part}\n\n{found[2]}", text, flags=re.DOTALL)
    return text


def write_page() -> None:
    """Write the tables of the page."""
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
