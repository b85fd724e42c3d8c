"""Null maps: what a correlation is without a trained network that looks at craters.

A null is named "<null>" if it applies to every gate, "<null>/stage_<k>" if to the gates of stage k, and
"<null>/<gate>" if to one gate.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from perilune_shared.geometry.frames import Array
from perilune_train.explain.correlation.measures import detector_values, pair_values
from perilune_train.explain.correlation.pearson import Maps
from perilune_train.explain.maps.baselines import Images, baseline_maps
from perilune_train.explain.maps.masks import Masks

DRAWS = 1000
"""Permutations of `permutation_p`."""


def detector_nulls(
    images: Images,
    masks: Masks,
    untrained: Masks,
    truth: Maps,
    brightness: Maps,
    gradient: Maps,
    frame_ids: Sequence[str],
    scene_ids: Sequence[str],
    rng: np.random.Generator,
    px_per_input_px: float = 1.0,
    other_scenes: bool = False,
) -> pd.DataFrame:
    """The long table of PCC1 and PCC2 of all null maps of N frames (N, height, width).

    Nulls: "edge", "contrast" and "brightness" of the images (`baseline_maps`); "untrained", the masks of an untrained
    network; "other frame", each gate's mask of a frame of another scene. The last has no PCC2, which does not depend on
    the order of the frames. The other arguments are those of `detector_values`.
    """
    maps = baseline_maps(images, px_per_input_px) | renamed("untrained", untrained)
    other = other_rows(scene_ids, rng)
    exchanged = renamed("other frame", {gate: found[other] for gate, found in masks.items()})
    known, shuffled = (
        detector_values(one, truth, brightness, gradient, frame_ids, scene_ids, "null", other_scenes)
        for one in (maps, exchanged)
    )
    return pd.concat([known, shuffled.loc[shuffled["measure"] != "pcc2"]], ignore_index=True)


def pair_nulls(
    first: Images,
    second: Images,
    masks: Masks,
    untrained: Masks,
    homographies: Sequence[Array],
    pair_ids: Sequence[str],
    scene_ids: Sequence[str],
    rng: np.random.Generator,
    px_per_input_px: float = 1.0,
) -> pd.DataFrame:
    """The long table of PCC3 and PCC4 of all null maps of N pairs, from earlier and later images (N, height, width).

    Only over the overlap of the two frames.

    Nulls: the baselines of both images; "untrained", the stacked masks (N, 2 height, width) of an untrained network;
    "other pair", each gate's mask with the lower half of another pair. The other arguments are those of `pair_values`.
    """
    upper, lower = (baseline_maps(images, px_per_input_px) for images in (first, second))
    maps = {name: np.concatenate([upper[name], lower[name]], axis=1) for name in upper}
    other, height = other_rows(scene_ids, rng), first.shape[1]
    for gate, found in masks.items():
        maps[f"other pair/{gate}"] = np.concatenate([found[:, :height], found[other, height:]], axis=1)
    return pair_values(maps | renamed("untrained", untrained), homographies, pair_ids, scene_ids, "null", False)


def renamed(null: str, masks: Masks) -> Masks:
    """The same masks with the names "<null>/<gate>"."""
    return {f"{null}/{gate}": found for gate, found in masks.items()}


def other_rows(scene_ids: Sequence[str], rng: np.random.Generator) -> np.ndarray:
    """For each of N rows the number (N,) of a random row of another scene; of another row if there is one scene."""
    scenes = np.asarray(scene_ids)
    if len(scenes) < 2:
        raise ValueError(f"{len(scenes)} frames, at least 2 expected")
    rows = np.arange(len(scenes))
    alone = len(np.unique(scenes)) == 1
    return np.array([rng.choice(rows[rows != n] if alone else rows[scenes != scenes[n]]) for n in rows])


def permutation_p(
    correlations: ArrayLike, scene_ids: Sequence[str], rng: np.random.Generator, n_draws: int = DRAWS
) -> float:
    """One-sided p of the mean of the diagonal of correlations (N, N) of mask n with ground truth m.

    Exchanges the ground truth of whole scenes, which are the independent units. A frame gets the frame at the same
    relative position in the other scene's frames, so that altitudes stay alike. p is (1 + draws that reach the observed
    mean) / (1 + n_draws) (Phipson & Smyth 2010, doi 10.2202/1544-6115.1585). With S scenes it is about 1 / S! at least.
    For a gate that is weaker on craters, pass the negative. NaN values are left out; NaN if no diagonal value is
    defined.
    """
    values = np.asarray(correlations, np.float64)
    if np.isnan(np.diagonal(values)).all():
        return float("nan")
    _, of_row = np.unique(np.asarray(scene_ids), return_inverse=True)
    members = [np.flatnonzero(of_row == scene) for scene in range(of_row.max() + 1)]
    everyone = np.arange(len(values))
    observed, reached = np.nanmean(np.diagonal(values)), 0
    for _ in range(n_draws):
        partner = everyone.copy()
        for own, to in zip(members, rng.permutation(len(members)), strict=True):
            partner[own] = members[to][np.arange(len(own)) * len(members[to]) // len(own)]
        drawn = values[everyone, partner]
        reached += bool(np.isfinite(drawn).any() and np.nanmean(drawn) >= observed - 1e-12)
    return (1 + reached) / (1 + n_draws)
