"""Null maps: maps without a trained network's attention to the frame, for comparison with gates.

A null is named "<null>" if it applies to every gate, "<null>/stage_<k>" if it applies to the gates of stage k, and
"<null>/<gate>" if it applies to one gate.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch
from torch import nn

from perilune_train.explain.correlation.measures import FrameTargets, PairTargets, detector_values, pair_values
from perilune_train.explain.maps.baselines import Images, baseline_maps
from perilune_train.explain.maps.masks import Masks


def detector_nulls(
    images: Images,
    masks: Masks,
    untrained: Masks,
    targets: FrameTargets,
    rng: np.random.Generator,
) -> pd.DataFrame:
    """The long table of PCC1 and PCC2 of all null maps of N frames (N, height, width).

    - "edge", "contrast", "brightness": `baseline_maps` of the images
    - "untrained": masks of an untrained network
    - "other frame": each gate's mask for a frame of another scene. PCC2 is left out, because exchanging frames does not
      change it.
    """
    maps = baseline_maps(images) | renamed("untrained", untrained)
    exchanged = renamed("other frame", of_other_rows(masks, targets.scene_ids, rng))
    known, shuffled = (detector_values(null_maps, targets, "null") for null_maps in (maps, exchanged))
    return pd.concat([known, shuffled.loc[shuffled["measure"] != "pcc2"]], ignore_index=True)


def pair_nulls(
    pairs: Images,
    masks: Masks,
    untrained: Masks,
    targets: PairTargets,
    rng: np.random.Generator,
    px_per_input_px: float = 1.0,
) -> pd.DataFrame:
    """The long table of PCC3 and PCC4 of all null maps of N pairs (N, 2 height, width), the earlier frame above.

    - "edge", "contrast", "brightness": `baseline_maps` of both frames
    - "untrained": masks (N, 2 height, width) of an untrained network
    - "other pair": each gate's mask, with the lower half replaced by the lower half of a pair of another scene

    Correlations use only the overlap of the two frames.
    """
    first, second = np.split(pairs, 2, axis=1)
    upper, lower = (baseline_maps(images, px_per_input_px) for images in (first, second))
    maps = {name: np.concatenate([upper[name], lower[name]], axis=1) for name in upper}
    height = first.shape[1]
    for gate, other in of_other_rows(masks, targets.scene_ids, rng).items():
        maps[f"other pair/{gate}"] = np.concatenate([masks[gate][:, :height], other[:, height:]], axis=1)
    return pair_values(maps | renamed("untrained", untrained), targets, "null", False)


def renamed(null: str, masks: Masks) -> Masks:
    """The masks, renamed to "<null>/<gate>"."""
    return {f"{null}/{gate}": gate_masks for gate, gate_masks in masks.items()}


def of_other_rows(masks: Masks, scene_ids: Sequence[str], rng: np.random.Generator) -> Masks:
    """Masks (N, height, width) of other frames, in the order of `other_rows`; NaN if there is only one frame."""
    if len(scene_ids) < 2:
        return {gate: np.full_like(gate_masks, np.nan) for gate, gate_masks in masks.items()}
    other = other_rows(scene_ids, rng)
    return {gate: gate_masks[other] for gate, gate_masks in masks.items()}


def other_rows(scene_ids: Sequence[str], rng: np.random.Generator) -> np.ndarray:
    """For each of N rows, the index (N,) of a random row of another scene.

    With only one scene, the index of any other row. Raises ValueError with fewer than two rows.
    """
    scenes = np.asarray(scene_ids)
    if len(scenes) < 2:
        raise ValueError(f"got {len(scenes)} frames, expected at least 2")
    rows = np.arange(len(scenes))
    alone = len(np.unique(scenes)) == 1
    return np.array([rng.choice(rows[rows != n] if alone else rows[scenes != scenes[n]]) for n in rows])


@torch.no_grad()
def measure_statistics(network: nn.Module, *given: torch.Tensor) -> None:
    """Set an untrained network's batch statistics from one batch, and switch the network to evaluation mode.

    `given` are the network's inputs. Without measured statistics, the features of an untrained network shrink from
    layer to layer.
    """
    for norm in network.modules():
        if isinstance(norm, nn.BatchNorm2d):
            norm.reset_running_stats()
            norm.momentum = None
    network.train()
    network(*given)
    network.eval()
