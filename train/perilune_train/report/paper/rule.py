"""The rule by which a claim holds, does not hold or is open.

The rule is symmetric in the sign. With `MIN_TRAININGS` trainings or more of each network, a claim holds if every
training with attention is better than every training without, and does not hold if every one is worse. With one
training of each, it holds or does not hold only if the intervals are separated. Otherwise it is open.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from perilune_train.records.metrics_file import Metrics
from perilune_train.records.spread import Interval, read_spread
from perilune_train.report.paper.tables import numbers

Answer = Literal["holds", "does not hold", "open", "not measured"]
AS_FAST = 1.05
"""Largest ratio of two times, in either direction, that counts as equal."""
MIN_TRAININGS = 3
"""Number of trainings of each network from which their order decides. With three of each, chance puts all trainings of
one network above all of the other once in ten times."""


@dataclass(frozen=True)
class Verdict:
    """One claim."""

    claim: str
    """What the paper says."""
    claimed: str
    """The paper's figures."""
    measured: str
    """Our figures: with attention against without."""
    trainings: str
    """Number of trainings on which the answer rests."""
    answer: Answer
    """Answer by the rule at the top of this file. not measured: a run or a figure is missing."""


def compared(key: str, attended: Sequence[Metrics], plain: Sequence[Metrics], *, higher: bool) -> Answer:
    """Answer to the claim that attention makes a figure higher (or lower), from trainings with and without it."""
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
    """Answer from two ranges: open if they overlap or one is unknown."""
    if ours is None or other is None:
        return "open"
    above, below = ours[0] > other[1], ours[1] < other[0]
    if not above and not below:
        return "open"
    return "holds" if above == higher else "does not hold"
