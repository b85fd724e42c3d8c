"""Parts of the paper's experiment: all of it, or what fits two cores."""

from dataclasses import dataclass, field
from enum import StrEnum


class Part(StrEnum):
    """How much of the experiment is made."""

    WHOLE = "whole"
    QUARTER = "quarter"
    TWENTIETH = "twentieth"


@dataclass(frozen=True)
class Cut:
    """What a part leaves out."""

    detect_every: int = 1
    """One of so many detection frames of each trajectory is taken."""
    nav_trajectories: int | None = None
    """The first so many navigation trajectories are taken; None for all."""
    own_epochs: int = 5
    """Epochs of our own network that the backbones start from."""
    benchmark_scenes: int = 0
    """Scenes of each part of the locked benchmark; 0 for all."""
    settings: dict[str, str] = field(default_factory=dict)
    """Settings of the networks."""
    lines: tuple[str, ...] = ()
    """What the page says was cut."""


_TWO_CORES = {
    "detect.epochs": "4",
    "detect.frozen_epochs": "1",
    "detect.batch_size": "8",
    "detect.warmup_steps": "200",
    "detect.workers": "0",
    "navigate.workers": "0",
    "navigate.stack.coarse_epochs": "20",
    "navigate.stack.fine_epochs": "4",
    "navigate.stack.batch_sequences": "1",
    "navigate.stack.accumulate": "8",
}
"""Settings that fit two cores and 16 GB."""
_FEWER_EPOCHS = (
    "4 epochs of the detectors (the first frozen), 4 fine epochs of the navigators; the navigators' batch norms see "
    "one sequence at a time"
)

PARTS = {
    Part.WHOLE: Cut(),
    Part.QUARTER: Cut(
        detect_every=4,
        settings=_TWO_CORES,
        lines=(f"cut to fit two cores: every fourth detection frame, {_FEWER_EPOCHS}",),
    ),
    Part.TWENTIETH: Cut(
        detect_every=20,
        nav_trajectories=12,
        own_epochs=2,
        benchmark_scenes=2,
        settings=_TWO_CORES | {"detect.warmup_steps": "50"},
        lines=(
            "cut to fit two cores: every twentieth detection frame, the first 12 of 49 navigation "
            f"trajectories, {_FEWER_EPOCHS}; 2 epochs of the network that the backbones start from; 6 of the 20 "
            "scenes of the locked benchmark",
        ),
    ),
}
