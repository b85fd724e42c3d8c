"""The rule that decides whether a claim holds, does not hold or is open.

The rule treats better and worse symmetrically. With at least `MIN_TRAININGS` training runs of each network, a claim
holds if every run with attention is better than every run without attention, and does not hold if every run with
attention is worse than every run without. With one training run of each network, the claim holds or does not hold only
if the intervals of the two runs do not overlap. In all other cases the claim is open.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from perilune_train.records.metrics_file import Metrics
from perilune_train.records.spread import Interval, read_spread
from perilune_train.report.paper.tables import numbers

Answer = Literal["holds", "does not hold", "open", "not measured"]
AS_FAST = 1.05
"""Two times count as equal if the longer time divided by the shorter time is at most this ratio."""
MIN_TRAININGS = 3
"""Smallest number of training runs of each network at which the order of the runs decides. With three runs of each
network, chance alone puts all runs of one network above all runs of the other network in one of ten cases."""


@dataclass(frozen=True)
class Verdict:
    """One claim of the paper and the answer to it."""

    claim: str
    """The claim."""
    claimed: str
    """The paper's values: with attention against without, such as 0.9 against 0.8."""
    measured: str
    """Our values: with attention against without."""
    trainings: str
    """Number of training runs on which the answer is based."""
    answer: Answer
    """Answer by the rule at the top of this file; "not measured" if a run or a figure is missing."""


def compared(key: str, attended: Sequence[Metrics], plain: Sequence[Metrics], *, higher: bool) -> Answer:
    """Answer to the claim that attention makes a figure higher (or lower).

    `attended` are the training runs with attention, `plain` the training runs without.
    """
    ours, others = numbers(attended, key), numbers(plain, key)
    if not ours or not others:
        return "not measured"
    if len(ours) == len(others) == 1:
        intervals = [read_spread(runs[0], key).interval for runs in (attended, plain)]
        return by_order(intervals[0], intervals[1], higher)
    if min(len(ours), len(others)) < MIN_TRAININGS:
        return "open"
    return by_order((min(ours), max(ours)), (min(others), max(others)), higher)


def by_order(ours: Interval | None, other: Interval | None, higher: bool) -> Answer:
    """Answer from the order of two ranges; open if the ranges overlap or if a range is unknown."""
    if ours is None or other is None:
        return "open"
    above, below = ours[0] > other[1], ours[1] < other[0]
    if not above and not below:
        return "open"
    return "holds" if above == higher else "does not hold"
