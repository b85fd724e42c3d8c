"""Compute evidence on the stack navigator's gates: correlations with nulls, interventions, stability."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from perilune_shared.console.terminal import say
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.correlation.measures import PairTargets, pair_values
from perilune_train.explain.detection import SHALLOW_STAGES
from perilune_train.explain.evidence.gates import forced_gates, gate_means
from perilune_train.explain.evidence.nulls import measure_statistics, pair_nulls
from perilune_train.explain.evidence.performance import MotionPerformance
from perilune_train.explain.evidence.permutation import pair_permutations
from perilune_train.explain.evidence.randomisation import randomised
from perilune_train.explain.evidence.removal import removal_effect
from perilune_train.explain.evidence.significance import against_nulls, null_differences, summary
from perilune_train.explain.evidence.stability import stability
from perilune_train.explain.evidence.tables import Evidence
from perilune_train.explain.inputs import Pairs, evenly_spaced
from perilune_train.explain.maps.baselines import baseline_maps
from perilune_train.explain.maps.masks import Masks, navigator_masks, stacked_input
from perilune_train.models.navigator import StackNavigator
from perilune_train.motion.network import build, target_of

TASK = "navigate"


def explain_navigator(
    settings: ExplainConfig,
    navigator: StackNavigator,
    architecture: dict[str, Any],
    pairs: Pairs,
    validation: Pairs,
    where: Path,
) -> tuple[Evidence, Masks]:
    """All evidence tables of the stack navigator, and its masks for the test pairs (N, 2 height, width).

    The gate whose pixels are removed is chosen on the validation pairs. Raises UserError if the network has no
    attention; the message names the checkpoint `where`.
    """
    size_px = architecture["size_px"]
    rng = np.random.default_rng([settings.seed, 2])

    def masks_of(images: NDArray[np.uint8]) -> Masks:
        return navigator_masks(navigator, images, size_px, where)

    masks, validation_masks = masks_of(pairs.images), masks_of(validation.images)
    untrained = untrained_navigator(navigator, architecture, validation.images, settings.seed)
    untrained_masks = navigator_masks(untrained, pairs.images, size_px, where)
    say("navigator: masks and null maps")
    strongest = strongest_gate(validation_masks, validation)
    targets, scale = _targets(pairs), pairs.images.shape[2] / size_px
    nulls = pair_nulls(pairs.images, masks, untrained_masks, targets, rng, scale)
    values = pd.concat([pair_values(masks, targets), nulls], ignore_index=True)
    permutations = pair_permutations(masks, targets, rng)
    differences = pd.concat([null_differences(values, {}, rng), permutations], ignore_index=True)

    truth_m = pairs.position_m if target_of(architecture) == "pose" else pairs.translation_m
    length = truth_m.shape[1]
    runs = evenly_spaced(len(truth_m), max(1, settings.n_changed_pairs // length))
    changed = [length * run + k for run in runs for k in range(length)]
    images = pairs.images[changed]
    ids = pd.DataFrame({"frame_id": pairs.pair_ids, "scene_id": pairs.scene_ids}).iloc[changed].reset_index(drop=True)
    scales = architecture["scales"]
    measure = MotionPerformance(
        navigator, truth_m[runs], np.array(scales["mean_m"]), np.array(scales["spread_m"]), size_px
    )
    gates = forced_gates(
        navigator.backbone, gate_means(validation_masks), images, measure, "force gates of the navigator"
    )
    edge = f"edge/stage_{strongest[2]}"
    halved = [baseline_maps(half, scale)[edge] for half in np.split(images, 2, axis=1)]
    to_remove = {strongest: masks[strongest][changed], edge: np.concatenate(halved, axis=1)}
    say(f"navigator: removing the pixels selected by {strongest} (chosen on validation pairs) and by the edge map")
    removal = removal_effect(images, to_remove, dict.fromkeys(to_remove, 1), measure, rng, settings.removed_share)

    few = images[: max(2, settings.n_changed // 2)]
    evidence = Evidence(
        values,
        summary(values, rng),
        differences,
        against_nulls(differences),
        gates.merge(ids, left_on="image", right_index=True),
        removal.merge(ids, left_on="frame_index", right_index=True),
        randomised(navigator, masks_of, few, settings.seed),
        stability(masks_of, few, rng, stacked=2),
        dict.fromkeys(masks, 1),
        strongest,
    )
    return evidence, masks


def untrained_navigator(
    trained: StackNavigator, architecture: dict[str, Any], pairs: NDArray[np.uint8], seed: int
) -> StackNavigator:
    """An untrained network of the same architecture, with batch statistics of `pairs` (N, 2 height, width)."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network: Any = build(architecture)
    device = next(trained.parameters()).device
    network.to(device)
    first, second = stacked_input(pairs, architecture["size_px"])
    measure_statistics(network, torch.from_numpy(first[None]).to(device), torch.from_numpy(second[None]).to(device))
    return network


def _targets(pairs: Pairs) -> PairTargets:
    return PairTargets(list(pairs.homographies), pairs.pair_ids, pairs.scene_ids)


def strongest_gate(masks: Masks, validation: Pairs) -> str:
    """The gate up to stride 8 with the largest mean PCC4 on validation pairs.

    The first gate if no gate has a defined PCC4.
    """
    values = pair_values(masks, _targets(validation))
    rows = values[(values["measure"] == "pcc4") & values["map"].str[2].isin(list(SHALLOW_STAGES))]
    means = rows.groupby("map", sort=False)["value"].mean()
    return str(means.idxmax()) if means.notna().any() else str(means.index[0])
