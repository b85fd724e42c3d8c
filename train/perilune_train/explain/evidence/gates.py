"""Force attention gates to their means, to measure how much worse the output becomes without their patterns.

The spatial mask of a gate is replaced by the mask's mean over pixels and frames. Channel gates are unchanged. This test
is needed because a mask that correlates with craters may have no effect on the output.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from torch import Tensor

from perilune_shared.console.terminal import progress_bar
from perilune_train.explain.evidence.significance import summary, unit_sign_flip_p
from perilune_train.explain.maps.masks import Masks
from perilune_train.models.darknet import AttentionDarknet53

ALL = "all gates"
"""Name of the scope with all gates."""


def gate_means(masks: Masks) -> dict[str, float]:
    """Mean of each gate's mask over pixels and images."""
    return {block: float(gate_masks.mean()) for block, gate_masks in masks.items()}


def scopes(blocks: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Gates that are forced together, by scope: each gate alone, the gates of each stage ("stage 3"), all gates.

    A stage with one gate has no scope of its own.
    """
    stages = sorted({block[2] for block in blocks})
    alone = {block: (block,) for block in blocks}
    together = {f"stage {stage}": tuple(block for block in blocks if block[2] == stage) for stage in stages}
    return {**alone, **{stage: gates for stage, gates in together.items() if len(gates) > 1}, ALL: tuple(blocks)}


@contextmanager
def forced(backbone: AttentionDarknet53, means: Mapping[str, float]) -> Iterator[None]:
    """Replace the spatial masks of the gates in `means` by constants while the block runs."""

    def constant(value: float) -> Callable[[Tensor], Tensor]:
        return lambda x: x.new_full((len(x), 1, *x.shape[2:]), value)

    gates = {block: backbone.attentions[block] for block in means}
    try:
        for block, gate in gates.items():
            # An instance attribute hides the method of the class until it is deleted.
            object.__setattr__(gate, "spatial_gate", constant(means[block]))
        yield
    finally:
        for gate in gates.values():
            gate.__dict__.pop("spatial_gate", None)


def forced_gates(
    backbone: AttentionDarknet53,
    means: Mapping[str, float],
    images: NDArray[np.uint8],
    measure: Callable[[NDArray[np.uint8]], NDArray[np.float64]],
    label: str,
) -> pd.DataFrame:
    """Performance on each image before and after forcing the gates of each scope to their means.

    `measure` returns one value per image. Columns: scope, image (index), before, after.
    """
    before, tables = measure(images), []
    chosen = scopes(list(means))
    with progress_bar() as progress:
        task = progress.add_task(label, total=len(chosen), unit="gates", note="")
        for scope, blocks in chosen.items():
            with forced(backbone, {block: means[block] for block in blocks}):
                after = measure(images)
            columns = {"scope": scope, "image": np.arange(len(images)), "before": before, "after": after}
            tables.append(pd.DataFrame(columns))
            progress.advance(task)
    return pd.concat(tables, ignore_index=True)


def forced_summary(gates: pd.DataFrame, higher_is_better: bool, rng: np.random.Generator) -> pd.DataFrame:
    """Mean harm of forcing the gates of each scope, in one row for each scope.

    `gates` is the table of `forced_gates` with the columns frame_id and scene_id. Harm is before - after, or
    after - before if lower values are better. Columns:

    - scope
    - value, low, high: mean over frames and its 95 % interval over scenes (NaN with fewer than five)
    - n_units, unit: number and kind of units with a value
    - p: one-sided p, by sign flips of the means of scenes, of a harm above 0
    """
    change = (gates["before"] - gates["after"]) * (1 if higher_is_better else -1)
    names = {"task": "", "kind": "forced", "map": gates["scope"], "measure": "harm"}
    table = pd.DataFrame({**names, "frame_id": gates["frame_id"], "scene_id": gates["scene_id"], "value": change})
    means = summary(table, rng)[["map", "value", "low", "high", "n_units", "unit"]].rename(columns={"map": "scope"})
    by_scene = table.groupby(["map", "scene_id"])["value"].mean()
    means["p"] = [unit_sign_flip_p(by_scene[scope].to_numpy(np.float64)) for scope in means["scope"]]
    return means
