"""Verdicts on all claims of the paper: our measurement, and whether the claim holds by the rule in rule.py."""

import math
from collections.abc import Sequence

from perilune_train.records.metrics_file import Metrics
from perilune_train.report.paper.claimed import DETECTION, NAVIGATION
from perilune_train.report.paper.detections import WidthRatio
from perilune_train.report.paper.gates import gate_verdicts
from perilune_train.report.paper.rule import AS_FAST, Answer, Verdict, by_order, compared
from perilune_train.report.paper.runs import NAVIGATORS, READINGS, PaperRuns
from perilune_train.report.paper.tables import FLOORS, lost_to, numbers, values

ONE = "one training run each"
_CONSTANT_DEG = 1e-4
"""The orientation counts as constant if predicting its mean has an error below this limit, degrees. This is the case
without attitude noise."""
GATES = {"attention-yolov3": "plain CBAM", "attention-identity": "gates from identity"}
"""Form of the gates of each detector with attention, in words."""


def verdicts(runs: PaperRuns, large: WidthRatio | None) -> list[Verdict]:
    """Verdicts on all claims in the order of the paper.

    `large` is the width ratio of the large craters detected by attention-YOLOv3; None if unknown.
    """
    answers = []
    for key, (name, claimed) in _detection_claims().items():
        answers += [
            _detection(runs, f"attention raises {name} ({GATES[gates]})", claimed, key, gates) for gates in GATES
        ]
    answers.append(_large_craters(large))
    for reading in READINGS:
        answers += _navigation(runs, reading)
    return [*answers, _as_fast(runs), *gate_verdicts(runs.explanation() or {})]


def _detection_claims() -> dict[str, tuple[str, str]]:
    """Name of each compared figure and the paper's values, by the figure's key in metrics.json."""
    names = {"precision": "precision", "recall": "recall", "ap50_paper": "AP", "f1": "F1"}
    plain, attended = DETECTION.values()
    compared = {f"test/{key}": (name, f"{attended[key]:.4f} against {plain[key]:.4f}") for key, name in names.items()}
    compared |= {
        f"test/strict/{key}": (f"{names[key]}, strict scoring", compared[f"test/{key}"][1])
        for key in ("precision", "ap50_paper")
    }
    small = {"2_3": "AP of small craters, 2 to 3 px", "3_5": "AP of small craters, 3 to 5 px"}
    return compared | {f"test/radius_{bin_}_px/ap50_paper": (name, "no figure") for bin_, name in small.items()}


def _detection(runs: PaperRuns, claim: str, claimed: str, key: str, gates: str) -> Verdict:
    """Verdict from the training runs at half width if there are several, with the run at full width added.

    With fewer than two training runs at half width, the verdict is from the run at full width.
    """
    full, half = runs.detections(), runs.halves()
    counts = [len(numbers(half[network], key)) for network in (gates, "yolov3")]
    pair = full[gates], full["yolov3"]
    alone = compared(key, *pair, higher=True)
    if min(counts) < 2:
        return Verdict(claim, claimed, _measured(key, *pair), _of(alone, ONE), alone)
    answer = compared(key, half[gates], half["yolov3"], higher=True)
    if {answer, alone} == {"holds", "does not hold"}:
        answer = "open"
    measured = _measured(key, half[gates], half["yolov3"])
    if alone != "not measured":
        measured += f"; full width, one training run each: {_measured(key, *pair)}, {alone}"
    each = f"{counts[0]}" if counts[0] == counts[1] else " and ".join(map(str, counts))
    return Verdict(claim, claimed, measured, f"{each} each, half width", answer)


def _measured(key: str, attended: Sequence[Metrics], plain: Sequence[Metrics]) -> str:
    known = numbers(plain, key)
    if not known and not numbers(attended, key):
        return "-"
    size = max(map(abs, known), default=0.0)
    # Show four digits, so that small differences are visible.
    digits = max(0, 3 - math.floor(math.log10(size))) if size else 3
    return f"{values(attended, key, digits)} against {values(plain, key, digits)}"


def _of(answer: Answer, trainings: str) -> str:
    return "-" if answer == "not measured" else trainings


def _large_craters(ratio: WidthRatio | None) -> Verdict:
    claim = "with attention, boxes of large craters (radius 20 to 50 px) are slightly smaller than the truth"
    if ratio is None:
        return Verdict(claim, "no figure", "-", "-", "not measured")
    limits = f" ({ratio.interval[0]:.3f} to {ratio.interval[1]:.3f})" if ratio.interval else ""
    answer = by_order(ratio.interval, (1.0, 1.0), higher=False)
    return Verdict(
        claim, "no figure", f"median width {ratio.median:.3f}{limits} of the true width", "one training run", answer
    )


def _navigation(runs: PaperRuns, reading: str) -> list[Verdict]:
    navigation = runs.navigation(reading)
    plain, attended = ([navigation[name]] if name in navigation else [] for name in NAVIGATORS)
    where = {"pose": "pose in O_L", "attitude": "pose in O_L, attitude noise", "motion": "motion between frames"}[
        reading
    ]
    verdicts = []
    for what, field in (("position", "position_m"), ("orientation", "orientation_deg")):
        unit = field.rpartition("_")[2]
        key = f"test/{what}_rmse_per_component_{unit}"
        claim = f"attention lowers the {what} RMSE, per component ({where})"
        claimed = " against ".join(f"{figures[field]:g} {unit}" for figures in reversed(NAVIGATION.values()))
        answer = compared(key, attended, plain, higher=False)
        measured = _measured(key, attended, plain)
        if what == "orientation" and answer != "not measured" and _is_constant([*plain, *attended], key):
            measured, answer = "the true orientation is constant; ATTITUDE=1 measures it", "not measured"
        elif what == "position":
            names = (("with", attended), ("without", plain))
            lost = {name: lost_to(trainings[0]) for name, trainings in names if trainings}
            measured += "".join(
                f"; {name} attention, not better than the {FLOORS[by]}" for name, by in lost.items() if by
            )
        verdicts.append(Verdict(claim, claimed, measured, _of(answer, ONE), answer))
    return verdicts


def _is_constant(trained: Sequence[Metrics], key: str) -> bool:
    """Whether the true orientation is nearly constant, so that predicting its mean has a small error.

    If the error of the mean was not measured, the errors of all networks must be small.
    """
    means = [f"baseline/{name}/{key.removeprefix('test/')}" for name in ("mean", "mean_pose")]
    known = [value for mean in means for value in numbers(trained, mean)] or numbers(trained, key)
    return max(known) < _CONSTANT_DEG


def _as_fast(runs: PaperRuns) -> Verdict:
    """Verdict from the seconds per pair for each reading (key of `READINGS`) and on the benchmark.

    Times of two networks are compared only if they were measured on equal hardware by the same command.
    """
    claim, claimed = "a pair takes as long with attention as without", "0.22 s both"
    pairs = {reading: list(runs.navigation(reading).values()) for reading in READINGS}
    scored = [runs.scored(name) for name in NAVIGATORS.values()]
    pairs["locked benchmark"] = [metrics for metrics in scored if metrics is not None]
    key, ratios, listed = "test/ms_per_single_pair", [], []
    for setting, metrics_of_networks in pairs.items():
        times = numbers(metrics_of_networks, key)
        if len(times) < 2:
            continue
        without, with_ = times
        alike = len({(metrics.get("run/hardware"), _program(metrics)) for metrics in metrics_of_networks}) == 1
        ratios += [with_ / without] if alike else []
        note = "" if alike else ", different machines or commands, not compared"
        loads = " and ".join(f"{value:g}" for value in reversed(numbers(metrics_of_networks, "run/load")))
        load = f" at load {loads}" if loads else ""
        listed.append(f"{setting}: {with_ / 1e3:.3f} s against {without / 1e3:.3f} s{load}{note}")
    if not ratios:
        return Verdict(claim, claimed, "; ".join(listed) or "-", "-", "not measured")
    # 1: slower than the tolerance; -1: faster; 0: within the tolerance.
    sides = {(ratio > AS_FAST) - (ratio < 1 / AS_FAST) for ratio in ratios}
    answer: Answer = "holds" if sides == {0} else "does not hold" if sides in ({1}, {-1}) else "open"
    return Verdict(claim, claimed, "; ".join(listed), f"{len(ratios)} comparisons" if len(ratios) > 1 else ONE, answer)


def _program(metrics: Metrics) -> tuple[str, ...]:
    """The command that measured the time, without its options."""
    words = str(metrics.get("run/command") or "").split()
    return tuple(word for word in words[:3] if not word.startswith("-"))
