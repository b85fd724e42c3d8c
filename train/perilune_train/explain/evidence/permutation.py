"""The permutation null: the correlation that remains after the targets of different scenes are exchanged."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from perilune_shared.geometry.frames import Array
from perilune_train.explain.correlation.homography import moved_to_first, seen_in_second
from perilune_train.explain.correlation.measures import FrameTargets, PairTargets
from perilune_train.explain.correlation.pearson import given_basis, pearson_rows, residual_rows, standardised_rows
from perilune_train.explain.evidence.significance import Signs
from perilune_train.explain.maps.masks import Masks
from perilune_train.records.spread import MIN_UNITS

NULL = "permutation"
"""Name of the null in the table of differences."""
DRAWS = 1000
"""Number of permutations in a test."""
_PAIR_STEP = 4
"""Sampling step of stacked masks, pixels, in both directions."""


def permuted(
    correlations: ArrayLike, scene_ids: Sequence[str], rng: np.random.Generator, n_draws: int = DRAWS
) -> tuple[float, float]:
    """Permutation test of a mean diagonal: returns the mean over permutations, and the one-sided p.

    Element (n, m) of `correlations` (N, N) is the correlation of mask n with target m. The targets of whole scenes are
    exchanged, because scenes are the independent units. A frame at a relative position in its scene gets the target at
    this position in the other scene, so that altitudes stay similar. For a gate that is weaker on craters, pass the
    negated correlations. NaN values are left out; both results are NaN if no diagonal value is defined.

    p is (1 + draws that reach the observed mean) / (1 + n_draws) (Phipson & Smyth 2010, doi 10.2202/1544-6115.1585).
    With S scenes, p is at least about 1 / S!.
    """
    values = np.asarray(correlations, np.float64)
    if np.isnan(np.diagonal(values)).all():
        return float("nan"), float("nan")
    _, of_row = np.unique(np.asarray(scene_ids), return_inverse=True)
    members = [np.flatnonzero(of_row == scene) for scene in range(of_row.max() + 1)]
    everyone = np.arange(len(values))
    observed, means = np.nanmean(np.diagonal(values)), []
    for _ in range(n_draws):
        partner = everyone.copy()
        for rows, source in zip(members, rng.permutation(len(members)), strict=True):
            partner[rows] = members[source][np.arange(len(rows)) * len(members[source]) // len(rows)]
        drawn = values[everyone, partner]
        if np.isfinite(drawn).any():
            means.append(np.nanmean(drawn))
    reached = sum(mean >= observed - 1e-12 for mean in means)
    return float(np.mean(means)) if means else float("nan"), (1 + reached) / (1 + n_draws)


def detector_permutations(masks: Masks, targets: FrameTargets, signs: Signs, rng: np.random.Generator) -> pd.DataFrame:
    """Rows of the permutation null for pcc1_craterness and pcc1_partial, with the columns of `null_differences`.

    Masks are (N, height, width); `signs` come from `validation_signs`. There is no permutation null for PCC2, because
    PCC2 does not depend on the order of the frames.
    """
    basis = given_basis([targets.brightness, targets.gradient])
    craterness = standardised_rows(1 - targets.truth)
    residuals = residual_rows(craterness, basis)
    rows = []
    for gate, gate_masks in masks.items():
        mask_rows = standardised_rows(gate_masks)
        matrices = {
            "pcc1_craterness": mask_rows @ craterness.T,
            "pcc1_partial": residual_rows(mask_rows, basis) @ residuals.T,
        }
        for measure, matrix in matrices.items():
            signed = signs["detect", measure, gate] * matrix
            rows.append(_row("detect", measure, gate, signed, targets.scene_ids, rng))
    return pd.DataFrame(rows)


def pair_permutations(masks: Masks, targets: PairTargets, rng: np.random.Generator) -> pd.DataFrame:
    """Rows of the permutation null for pcc3, pcc4 and pcc4_minus_pcc3, with the columns of `null_differences`.

    Upper halves are compared with lower halves of pairs in other scenes. For pcc4, each lower half is moved by the
    homography of the upper half's pair. All N x N combinations are computed, so only every fourth pixel of the stacked
    masks (N, 2 height, width) is used. Values therefore differ slightly from the values of `pair_values`.
    """
    scale = np.diag([1 / _PAIR_STEP, 1 / _PAIR_STEP, 1.0])
    small = [scale @ homography @ np.linalg.inv(scale) for homography in targets.homographies]
    rows = []
    for gate, gate_masks in masks.items():
        upper, lower = np.split(gate_masks, 2, axis=1)
        upper, lower = (
            half_masks[:, _PAIR_STEP // 2 :: _PAIR_STEP, _PAIR_STEP // 2 :: _PAIR_STEP] for half_masks in (upper, lower)
        )
        matrices: dict[str, list[Array]] = {"pcc3": [], "pcc4": []}
        for mask, homography in zip(upper, small, strict=True):
            seen = np.broadcast_to(seen_in_second(mask.shape, homography), lower.shape)
            same = np.broadcast_to(mask, lower.shape)
            matrices["pcc3"].append(pearson_rows(same, lower, seen))
            moved = np.stack([moved_to_first(half_masks, homography) for half_masks in lower])
            matrices["pcc4"].append(pearson_rows(same, moved, seen))
        both = {measure: np.stack(rows_of_measure) for measure, rows_of_measure in matrices.items()}
        both["pcc4_minus_pcc3"] = both["pcc4"] - both["pcc3"]
        rows += [_row("navigate", measure, gate, matrix, targets.scene_ids, rng) for measure, matrix in both.items()]
    return pd.DataFrame(rows)


def _row(
    task: str, measure: str, gate: str, matrix: Array, scene_ids: Sequence[str], rng: np.random.Generator
) -> dict[str, object]:
    diagonal = np.diagonal(matrix)
    value = float(np.nanmean(diagonal)) if np.isfinite(diagonal).any() else float("nan")
    null_value, p = permuted(matrix, scene_ids, rng)
    scenes = len(set(np.asarray(scene_ids)[np.isfinite(diagonal)].tolist()))
    names = {"task": task, "measure": measure, "map": gate, "null": NULL, "value": value, "null_value": null_value}
    interval = {"difference": value - null_value, "low": float("nan"), "high": float("nan")}
    tested = {"p_bootstrap": float("nan"), "p": p if scenes >= MIN_UNITS else float("nan")}
    return names | interval | {"n_units": scenes, "unit": "scene"} | tested
