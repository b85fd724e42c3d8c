"""Compute means, intervals and tests against null maps from a long table of values per frame.

The unit of intervals and tests is the scene. If there is only one scene, the unit is the trajectory (the part of
frame_id before the last "/").
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.stats import false_discovery_control

from perilune_train.records.spread import MIN_UNITS, Array, Resamples, Rows, draw_resamples, spreads

Signs = Mapping[tuple[str, str, str], float]
"""Sign of the mean on validation frames, 1 or -1, by task, measure and map."""
LEVEL = 0.05
"""Significance level, and false discovery rate of `against_nulls`."""
UNDECIDED = f"undecided: fewer than {MIN_UNITS} scenes"
UNDEFINED = "undefined: the mask is constant"
BEATS = "beats every null"
PAIRWISE = ("pcc2",)
"""Measures whose value for a frame is a mean over the frame's pairs with other frames."""
_FLIPS = 4096
"""Number of random sign flips; with up to 12 units, all flips are used instead."""
_GROUP = ["task", "kind", "map", "measure"]


def summary(table: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Mean and interval of each measure of each map, in one row for each task, kind, map and measure.

    - value: mean over the frames with a defined value
    - low, high: ends of the 95 % interval of the mean, by bootstrap over units; NaN with fewer than 5 units
    - n_units, unit: number and kind of units (scene, trajectory or image)
    - undefined: number of NaN among the values
    - count: number of values
    """
    rows = []
    for _, task in table.groupby("task", sort=False):
        frames = _Frames.of(task, rng)
        for key, group_rows in task.groupby(_GROUP, sort=False):
            values = pairwise(str(key[-1]), frames.aligned(group_rows))
            mean = frames.mean(values)
            missing = {"undefined": int(group_rows["value"].isna().sum()), "count": len(group_rows)}
            rows.append(dict(zip(_GROUP, key, strict=True)) | mean.columns("value") | missing)
    return pd.DataFrame(rows)


def validation_signs(table: pd.DataFrame) -> dict[tuple[str, str, str], float]:
    """Sign of the mean of each PCC1 measure on validation frames, by task, measure and map; 1 if undefined."""
    rows = table[table["measure"].str.startswith("pcc1")]
    means = rows.groupby(["task", "measure", "map"], as_index=False)["value"].mean()
    keys = zip(means["task"], means["measure"], means["map"], strict=True)
    return {key: -1.0 if mean < 0 else 1.0 for key, mean in zip(keys, means["value"], strict=True)}


def null_differences(table: pd.DataFrame, signs: Signs, rng: np.random.Generator, kind: str = "gate") -> pd.DataFrame:
    """Difference between each map of `kind` and each null that applies to the map, paired over frames.

    Columns: task, measure, map, null, value and null_value (means of the map and of the null over their frames),
    difference (mean of map - null over the frames where both are defined), low, high, n_units, unit, p_bootstrap, p.
    The null "edge/stage_3" applies to the gates of stage 3, "untrained/B_11" to B_11, and a name without "/" to all
    gates. A null without any value is left out.

    PCC1 may have either sign. The values of each map are therefore multiplied by the map's sign on validation frames
    (`signs`). No sign is chosen on the frames of the table.

    Use p for decisions. It comes from a one-sided sign-flip test over units, which is exact if differences are
    symmetric around 0. The test uses all 2^S flips of S units for S up to 12, and 4096 flips for more. Its resolution
    is 2^-S: 0.031 with 5 scenes, 0.002 with 9 scenes.

    p_bootstrap is also one-sided: (1 + the number of resampled differences that are at most 0) / 1001, resampled over
    units. Its resolution is 0.001, but it reaches 0.001 by chance with probability 2^-S. With fewer than about 20
    units, p_bootstrap is therefore too small.

    Raises ValueError if the sign of a PCC1 measure is missing.
    """
    rows = []
    for name, task in table.groupby("task", sort=False):
        frames = _Frames.of(task, rng)
        for measure, measure_rows in task.groupby("measure", sort=False):
            values = {str(map_name): frames.aligned(part) for map_name, part in measure_rows.groupby("map", sort=False)}
            signed = {
                map_name: _sign(signs, str(name), str(measure), map_name) * map_values
                for map_name, map_values in values.items()
            }
            nulls = [
                map_name
                for map_name in measure_rows.loc[measure_rows["kind"] == "null", "map"].unique()
                if np.isfinite(values[map_name]).any()
            ]
            for gate in measure_rows.loc[measure_rows["kind"] == kind, "map"].unique():
                for null in (map_name for map_name in nulls if _applies(map_name, gate)):
                    difference = pairwise(str(measure), signed[gate] - signed[null])
                    means = {"value": _mean(signed[gate]), "null_value": _mean(signed[null])}
                    p_values = {"p_bootstrap": frames.bootstrap_p(difference), "p": frames.sign_flip_p(difference)}
                    who = {"task": name, "measure": measure, "map": gate, "null": null.partition("/")[0]}
                    rows.append(who | means | frames.mean(difference).columns("difference") | p_values)
    return pd.DataFrame(rows)


def pairwise(measure: str, values: Array) -> Array:
    """Values (N,) of frames; for PAIRWISE measures, with doubled deviations from the mean.

    Each pair of frames contributes to the values of both frames, so the mean is a U-statistic of order 2. A unit
    changes this mean by twice the deviation of the unit's mean (Hoeffding 1948, doi 10.1214/aoms/1177730196). With
    doubled deviations, resampling units gives the spread of the mean. The mean itself does not change.
    """
    if measure not in PAIRWISE:
        return values
    return 2 * values - _mean(values)


def unit_sign_flip_p(values: Array) -> float:
    """One-sided p, by sign flips, of a mean above 0 of the values (U,) of independent units.

    Uses all 2^U flips for up to 12 units, else 4096 random flips with a fixed seed. Units with NaN are left out.
    Returns NaN if no unit has a value.
    """
    values = values[np.isfinite(values)]
    if not len(values):
        return float("nan")
    flips = _flips(len(values), np.random.default_rng(0))
    return float(np.mean(flips @ values >= values.sum() - 1e-12 * np.abs(values).sum()))


def _flips(units: int, rng: np.random.Generator) -> Array:
    """Signs, 1 or -1, (flips, units): all combinations, or 4096 random ones. The first row is all 1."""
    if 2**units <= _FLIPS:
        return 1.0 - 2.0 * (np.arange(2**units)[:, None] >> np.arange(units) & 1)
    return np.vstack([np.ones(units), rng.choice([-1.0, 1.0], (_FLIPS - 1, units))])


def against_nulls(differences: pd.DataFrame) -> pd.DataFrame:
    """Test of each gate against all its nulls together, in one row for each task, measure and gate.

    `differences` is the table of `null_differences`. Columns: task, measure, map, value, n_units, unit, and

    - p: largest p over all nulls; an undefined p counts as 1. It tests whether the gate beats all nulls, and needs no
      correction for the number of nulls (Berger 1982, doi 10.1080/00401706.1982.10487790).
    - p_adjusted: p, corrected for the number of gates of the task and measure (Benjamini & Hochberg 1995, doi
      10.1111/j.2517-6161.1995.tb02031.x)
    - beats_all: whether p_adjusted is below 0.05, each difference is above 0, and at least 5 scenes have values.
      Trajectories of one scene do not suffice.
    - verdict: the result as text

    With S scenes, p is at least 2^-S. With 9 scenes or more, a single gate out of 23 can pass alone. With 5 scenes, at
    least 15 gates must pass together.
    """
    rows = []
    for (task, measure), family in differences.groupby(["task", "measure"], sort=False):
        gates = [(str(gate), gate_rows) for gate, gate_rows in family.groupby("map", sort=False)]
        largest = [float(gate_rows["p"].fillna(1.0).max()) for _, gate_rows in gates]
        for (gate, gate_rows), p, adjusted in zip(gates, largest, false_discovery_control(largest), strict=True):
            beats, verdict = _verdict(gate_rows, float(adjusted))
            rows.append(
                {
                    "task": task,
                    "measure": measure,
                    "map": gate,
                    "value": float(gate_rows["value"].iloc[0]),
                    "n_units": int(gate_rows["n_units"].min()),
                    "unit": gate_rows["unit"].iloc[0],
                    "p": p,
                    "p_adjusted": float(adjusted),
                    "beats_all": beats,
                    "verdict": verdict,
                }
            )
    return pd.DataFrame(rows)


@dataclass(frozen=True)
class _Mean:
    value: float
    """Mean over frames."""
    low: float
    """Lower end of the 95 % interval; NaN without an interval."""
    high: float
    """Upper end of the 95 % interval; NaN without an interval."""
    n_units: int
    """Number of units with a value."""
    unit: str
    """scene, trajectory or image."""

    def columns(self, name: str) -> dict[str, object]:
        ends = {"low": self.low, "high": self.high}
        return {name: self.value, **ends, "n_units": self.n_units, "unit": self.unit}


@dataclass(frozen=True)
class _Frames:
    """The frames of one task and their units, in one order for all maps."""

    ids: pd.Index
    """Names of the N frames."""
    resamples: Resamples
    """Resamples of their units."""
    flips: Array
    """Signs, 1 or -1, of the units (flips, U); the first row is all 1."""

    @classmethod
    def of(cls, task: pd.DataFrame, rng: np.random.Generator) -> "_Frames":
        frames = task[["frame_id", "scene_id"]].drop_duplicates()
        ids, scenes = [str(text) for text in frames["frame_id"]], [str(text) for text in frames["scene_id"]]
        if len(set(ids)) < len(ids):
            raise ValueError("a frame is in two scenes")
        resamples = draw_resamples(scenes, [text.rpartition("/")[0] for text in ids], ids, rng)
        return cls(pd.Index(ids), resamples, _flips(resamples.count, rng))

    def aligned(self, rows: pd.DataFrame) -> Array:
        """Values (N,) of one map and measure, in the order of `ids`; NaN for a frame without a value."""
        values = rows["value"].to_numpy(np.float64)
        aligned = np.full(len(self.ids), np.nan)
        row_of_frame = self.ids.get_indexer(pd.Index(rows["frame_id"].astype(str)))
        if len(np.unique(row_of_frame)) < len(row_of_frame):
            raise ValueError(f"two values of one frame for {rows['map'].iloc[0]}, {rows['measure'].iloc[0]}")
        aligned[row_of_frame] = values
        return aligned

    def mean(self, values: Array) -> _Mean:
        """Mean of the defined values (N,), with an interval unless units are images, which are not independent."""
        rows = np.flatnonzero(np.isfinite(values))
        spread = spreads(lambda drawn: {"mean": _ratio(drawn, rows, values)}, rows, self.resamples)["mean"]
        unit, n_units = self.resamples.unit, len(np.unique(self.resamples.of_row[rows]))
        low, high = spread.interval if spread.interval and unit != "image" else (np.nan, np.nan)
        return _Mean(_mean(values), low, high, n_units, unit)

    def bootstrap_p(self, values: Array) -> float:
        """One-sided p, by bootstrap, of a mean above 0 of the values (N,); NaN with fewer than 5 units."""
        rows = self._tested(values)
        if not len(rows):
            return float("nan")
        drawn = _ratio(self.resamples, rows, values)
        return float((1 + (drawn <= 0).sum()) / (1 + len(drawn)))

    def sign_flip_p(self, values: Array) -> float:
        """One-sided p, by sign flips, of a mean above 0 of the values (N,); NaN with fewer than 5 units."""
        rows = self._tested(values)
        if not len(rows):
            return float("nan")
        sums = np.bincount(self.resamples.of_row[rows], weights=values[rows], minlength=self.resamples.count)
        return float(np.mean(self.flips @ sums >= sums.sum() - 1e-12 * np.abs(sums).sum()))

    def _tested(self, values: Array) -> Rows:
        rows = np.flatnonzero(np.isfinite(values))
        enough = self.resamples.unit != "image" and len(np.unique(self.resamples.of_row[rows])) >= MIN_UNITS
        return rows if enough else rows[:0]


def _ratio(drawn: Resamples, rows: Rows, values: Array) -> Array:
    """Mean of values (N,) over `rows` in every resample (R,); NaN where a resample contains none of these rows."""
    counts = drawn.totals(rows)
    return np.where(counts > 0, drawn.totals(rows, values[rows]) / np.maximum(counts, 1), np.nan)


def _mean(values: Array) -> float:
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")


def _sign(signs: Signs, task: str, measure: str, name: str) -> float:
    if not measure.startswith("pcc1"):
        return 1.0
    if (task, measure, name) not in signs:
        raise ValueError(f"no sign of {name} on validation frames for {task}, {measure}")
    return signs[task, measure, name]


def _applies(null: str, gate: str) -> bool:
    _, _, target = null.partition("/")
    return target in ("", gate) or (target.startswith("stage_") and gate.startswith(f"B_{target[6:]}"))


def _verdict(rows: pd.DataFrame, p_adjusted: float) -> tuple[bool, str]:
    """Whether a gate beats all its nulls, and the verdict; `rows` are its differences."""
    if rows["value"].isna().all():
        return False, UNDEFINED
    if rows["unit"].iloc[0] != "scene" or rows["n_units"].min() < MIN_UNITS:
        return False, UNDECIDED
    weaker = (rows["p"] >= LEVEL) | (rows["difference"] <= 0)
    if p_adjusted < LEVEL and not weaker.any():
        return True, BEATS
    # If the gate fails only because of the correction for the number of gates, name the null with the largest p.
    names = rows.loc[weaker if weaker.any() else rows["p"] == rows["p"].max(), "null"]
    return False, "does not beat: " + ", ".join(sorted(set(names)))
