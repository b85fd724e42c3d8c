"""The figures of an explain run: what its metrics.json holds, so that every number of a page is on record."""

import math

import numpy as np

from perilune_train.explain.evidence.removal import removal_summary
from perilune_train.explain.evidence.tables import Evidence
from perilune_train.explain.page.correlation_claims import beating_gates
from perilune_train.explain.page.intervention_claims import forced_harm, removal_row
from perilune_train.records.metrics_file import Metrics

_COUNTED = {"detect": ("pcc1_craterness", "pcc1_partial"), "navigate": ("pcc4", "pcc4_minus_pcc3")}
"""Measures whose gates that beat every null are counted, by task."""


def figures_of(found: Evidence, task: str, *, higher_is_better: bool) -> Metrics:
    """Figures of one network by name; undefined ones are left out.

    <measure>/<map>, _low and _high: means of gates and attribution methods. <measure>_null/<gate>/<null>: means of the
    nulls. <measure>_p/<gate>: corrected for the number of gates. <task>/forced/<scope>: harm of forcing a gate, a stage
    or all. <task>/removal/<map>/<how>/<which>: harm of removed pixels. <task>/stability/<change>/<gate> and
    <task>/randomised/<direction>/<step>/<gate>: similarity of masks.
    """
    numbers: dict[str, float] = {}
    for row in found.summary[found.summary["kind"] != "null"].to_dict("records"):
        key = f"{row['measure']}/{row['map']}"
        numbers |= {key: row["value"], f"{key}_low": row["low"], f"{key}_high": row["high"]}
    for row in found.differences.to_dict("records"):
        numbers[f"{row['measure']}_null/{row['map']}/{row['null']}"] = row["null_value"]
    for row in found.tested.to_dict("records"):
        numbers[f"{row['measure']}_p/{row['map']}"] = row["p_adjusted"]
    for scope, harm in forced_harm(found, higher_is_better=higher_is_better).items():
        numbers[f"{task}/forced/{scope}"] = harm
    for row in removal_summary(found.removal, higher_is_better).to_dict("records"):
        for which in ("most", "least", "random", "shifted"):
            numbers[f"{task}/removal/{row['map']}/{row['how']}/{which}"] = row[which]
    alike = found.stability.groupby(["change", "map"], sort=False)["pearson"].mean()
    for row in alike.reset_index().to_dict("records"):
        numbers[f"{task}/stability/{row['change']}/{row['map']}"] = row["pearson"]
    kept = found.randomisation.groupby(["direction", "step", "map"], sort=False)["spearman"].mean()
    for row in kept.reset_index().to_dict("records"):
        numbers[f"{task}/randomised/{row['direction']}/{row['step']}/{row['map']}"] = row["spearman"]

    metrics: Metrics = {name: float(value) for name, value in numbers.items() if math.isfinite(value)}
    for row in found.tested.to_dict("records"):
        metrics[f"{row['measure']}_beats_nulls/{row['map']}"] = bool(row["beats_all"])
    least = removal_row(found, higher_is_better=higher_is_better)
    metrics |= {f"{task}/removal_{name}": float(least[name]) for name in ("most", "least", "random", "shifted")}
    # Without harm by a control there is no ratio.
    metrics[f"{task}/removal_ratio"] = float(least["ratio"]) if np.isfinite(least["ratio"]) else 0.0
    metrics[f"{task}/strongest_gate"] = found.strongest
    for measure in _COUNTED[task]:
        metrics[f"{task}/{measure}_beating_to_stride_8"] = len(beating_gates(found, measure))
        metrics[f"{task}/{measure}_beating"] = len(beating_gates(found, measure, "12345"))
    gates = found.summary[found.summary["kind"] == "gate"]
    metrics[f"{task}/undefined"] = int(gates["undefined"].sum())
    return metrics
