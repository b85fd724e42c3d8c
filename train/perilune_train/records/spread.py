"""Spread of a metric: a 95 % bootstrap interval over independent units, or the value of each unit.

The unit is the scene: frames of one scene are alike, so whole scenes are drawn with replacement. In a split with one
scene, the unit is the trajectory. If scenes and trajectories are unknown, the unit is the image. With fewer than five
units there is no interval; the value of each unit is given instead.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from perilune_shared.export.foreign_text import for_markdown

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Interval = tuple[float, float]
MIN_UNITS = 5
RESAMPLES = 1000
_PERCENTILES = (2.5, 97.5)


@dataclass(frozen=True)
class Resamples:
    """Bootstrap resamples: how often each of them contains each unit."""

    unit: str
    """scene, trajectory or image."""
    names: list[str]
    """Names of the units (U)."""
    of_row: Rows
    """Index of the unit of each row (N,); a row is a frame or a pair of frames."""
    weights: Array
    """Weight of each unit in each resample (R, U), for R resamples."""

    @property
    def count(self) -> int:
        """Number of units."""
        return len(self.names)

    def of_units(self, units: Rows) -> "Resamples":
        """Make one resample for each of `units`, which contains only this unit, once."""
        return replace(self, weights=np.eye(self.count)[units])

    def totals(self, rows: Rows, values: Array | None = None) -> Array:
        """Sum of `values` (L,) over `rows` (L,) in every resample (R,); without values, the number of rows."""
        return self.weights @ np.bincount(self.of_row[rows], weights=values, minlength=self.count)


@dataclass(frozen=True)
class Spread:
    """Spread of one metric over units."""

    unit: str
    """scene, trajectory or image."""
    interval: Interval | None
    """95 % interval; None with fewer than MIN_UNITS units."""
    by_unit: dict[str, float] = field(default_factory=dict)
    """Value of each unit; only if there is no interval."""

    def text(self, value: float | None, shown: Callable[[object], str] = for_markdown) -> str:
        """The value with its spread, if known; a dash if the value is undefined. `shown` escapes the names of units."""
        if value is None or not np.isfinite(value):
            return "-"
        known = {name: value_of_unit for name, value_of_unit in self.by_unit.items() if np.isfinite(value_of_unit)}
        if self.interval is not None and all(map(np.isfinite, self.interval)):
            return f"{value:.3f} ({self.interval[0]:.3f} to {self.interval[1]:.3f})"
        if known:
            return (
                f"{value:.3f} ("
                + ", ".join(f"{shown(name)} {value_of_unit:.3f}" for name, value_of_unit in known.items())
                + ")"
            )
        return f"{value:.3f}"

    def keys(self, key: str) -> dict[str, float | None]:
        """Entries for metrics.json.

        With an interval: <key>_low and <key>_high. Without: <key>_interval, which is null, and <key>/by_<unit>/<name>.
        """
        if self.interval is not None:
            return {f"{key}_low": self.interval[0], f"{key}_high": self.interval[1]}
        by_unit = {f"{key}/by_{self.unit}/{name}": value for name, value in self.by_unit.items()}
        return {f"{key}_interval": None, **by_unit}


def read_spread(figures: Mapping[str, object], key: str) -> Spread:
    """Read the entries of `Spread.keys` from flat metrics. If they are missing, the spread has no interval or units."""
    low, high = figures.get(f"{key}_low"), figures.get(f"{key}_high")
    if isinstance(low, float) and isinstance(high, float):
        return Spread("", (low, high))
    by_unit = {
        name.removeprefix(f"{key}/by_"): value for name, value in figures.items() if name.startswith(f"{key}/by_")
    }
    values = {name.partition("/")[2]: value for name, value in by_unit.items() if isinstance(value, float)}
    return Spread(next(iter(by_unit), "").partition("/")[0], None, values)


def draw_resamples(
    scenes: Sequence[str], trajectories: Sequence[str], images: Sequence[str], rng: np.random.Generator
) -> Resamples:
    """Draw RESAMPLES resamples of the units of N rows.

    The N names of scenes, trajectories and images define the units; an unknown name is "".
    """
    unit, names = "scene", scenes
    if len(set(scenes)) < 2:
        unit, names = ("trajectory", trajectories) if any(trajectories) else ("image", images)
    units, of_row = np.unique(np.asarray(names, dtype=str), return_inverse=True)
    count = len(units)
    weights = rng.multinomial(count, np.full(count, 1 / count), RESAMPLES) if count else np.zeros((RESAMPLES, 0))
    return Resamples(unit, units.tolist(), of_row.reshape(-1), weights.astype(np.float64))


def spreads(statistics: Callable[[Resamples], dict[str, Array]], rows: Rows, resamples: Resamples) -> dict[str, Spread]:
    """Spread of each metric that `statistics` computes for every resample (R,).

    `rows` are the rows that the metrics use. Units without any of these rows are left out.
    """
    units = np.unique(resamples.of_row[rows])
    if len(units) >= MIN_UNITS:
        drawn = statistics(resamples)
        return {name: Spread(resamples.unit, interval(values)) for name, values in drawn.items()}
    names = [resamples.names[unit] for unit in units]
    alone = statistics(resamples.of_units(units))
    return {
        name: Spread(resamples.unit, None, dict(zip(names, values.tolist(), strict=True)))
        for name, values in alone.items()
    }


def interval(values: Array) -> Interval | None:
    """The middle 95 % of resampled values (R,); None if fewer than two of them are defined."""
    known = values[np.isfinite(values)]
    if len(known) < 2:
        return None
    low, high = np.percentile(known, _PERCENTILES)
    return float(low), float(high)
