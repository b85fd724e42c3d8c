"""Compute the paper's correlations PCC1 to PCC4 for each image or pair, as rows of one long table.

Columns: task, kind, map, measure, frame_id, scene_id, value. Means, intervals and tests are computed from these rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.geometry.frames import Array
from perilune_train.explain.correlation.homography import moved_to_first, seen_in_second
from perilune_train.explain.correlation.pearson import (
    Maps,
    dot_rows,
    given_basis,
    partial_of_rows,
    residual_rows,
    standardised_rows,
)
from perilune_train.explain.maps.masks import Masks

Kind = Literal["gate", "null", "attribution"]
COLUMNS = ("task", "kind", "map", "measure", "frame_id", "scene_id", "value")
"""Columns of the long table."""
PCC1_SIGN = (
    "G is 1 on background and 0 in craters: pcc1_background above 0 means that the gate is weaker on craters; "
    "pcc1_craterness is the correlation with 1 - G, of the opposite sign"
)


@dataclass(frozen=True, slots=True)
class FrameTargets:
    """Images of N frames with which maps are correlated, and the names of the frames."""

    truth: Maps
    """The paper's masks G (N, height, width): 1 on background, 0 in craters."""
    brightness: Maps
    """Brightness of the frames (N, height, width)."""
    gradient: Maps
    """Magnitude of the brightness gradient (N, height, width)."""
    frame_ids: Sequence[str]
    """Ids of the frames (N)."""
    scene_ids: Sequence[str]
    """Scene of each frame (N)."""


@dataclass(frozen=True, slots=True)
class PairTargets:
    """True motions of N pairs of frames, and the names of the pairs."""

    homographies: Sequence[Array]
    """Homography (3, 3) of each pair (N), from pixels of the earlier (upper) to pixels of the later (lower) frame."""
    pair_ids: Sequence[str]
    """Ids of the pairs (N)."""
    scene_ids: Sequence[str]
    """Scene of each pair (N)."""


def detector_values(
    masks: Masks, targets: FrameTargets, kind: Kind = "gate", other_scenes: bool = False
) -> pd.DataFrame:
    """The long table of PCC1 and PCC2 for every map (N, height, width).

    - pcc1_background: the paper's PCC1, the correlation with G. G is 1 on background, so a value above 0 means that the
      map is lower on craters.
    - pcc1_craterness: the correlation with 1 - G. A value above 0 means that the map is higher on craters.
    - pcc1_partial: the partial correlation with 1 - G given brightness and gradient.
    - pcc2: the mean correlation between the frame's map and the maps of all other frames (with `other_scenes`: of all
      frames of other scenes). The paper uses one other frame and does not say which.

    Undefined values are NaN.
    """
    scenes = np.asarray(targets.scene_ids)
    paired = scenes[:, None] != scenes[None] if other_scenes else ~np.eye(len(scenes), dtype=bool)
    craterness = standardised_rows(1 - targets.truth)
    basis = given_basis([targets.brightness, targets.gradient])
    residuals = residual_rows(craterness, basis)
    tables = []
    for name, maps in masks.items():
        rows = standardised_rows(maps)
        pcc1 = dot_rows(rows, craterness)
        values = {
            "pcc1_background": -pcc1,
            "pcc1_craterness": pcc1,
            "pcc1_partial": partial_of_rows(rows, residuals, basis),
            "pcc2": _mean_defined(rows @ rows.T, paired),
        }
        for measure, measured in values.items():
            names = {"task": "detect", "kind": kind, "map": name, "measure": measure}
            tables.append(_table(names, measured, targets.frame_ids, targets.scene_ids))
    return pd.concat(tables, ignore_index=True)


def pair_values(masks: Masks, targets: PairTargets, kind: Kind = "gate", all_pixels: bool = True) -> pd.DataFrame:
    """The long table of PCC3 and PCC4 for every stacked map (N, 2 height, width) of N pairs.

    The column frame_id has the ids of the pairs. Measures:

    - pcc3: the correlation of the upper with the lower half, over the overlap. The overlap is the pixels of the upper
      frame whose ground is also in the lower frame.
    - pcc4: as pcc3, with the lower half moved by the true motion.
    - pcc4_minus_pcc3: the increase due to the true motion.
    - pcc3_all_pixels, pcc4_all_pixels: over all pixels. Outside the overlap the moved half is 0, OpenCV's default. The
      paper uses all pixels, at least for PCC3, and does not define the moved half outside the overlap.

    If pcc3 or pcc4 of a pair is undefined, both are NaN, so that their means are over equal sets of pairs; likewise for
    the measures over all pixels. Without `all_pixels` these are not computed, which takes half the time.
    """
    height, width = (size // part for size, part in zip(next(iter(masks.values())).shape[1:], (2, 1), strict=True))
    seen = np.stack([seen_in_second((height, width), homography) for homography in targets.homographies])
    tables = []
    for name, maps in masks.items():
        upper, lower = maps[:, :height], maps[:, height:]
        moved = np.stack([moved_to_first(mask, h) for mask, h in zip(lower, targets.homographies, strict=True)])
        seen_upper = standardised_rows(upper, seen)
        values = {
            "pcc3": dot_rows(seen_upper, standardised_rows(lower, seen)),
            "pcc4": dot_rows(seen_upper, standardised_rows(moved, seen)),
        }
        if all_pixels:
            whole = standardised_rows(upper)
            values["pcc3_all_pixels"] = dot_rows(whole, standardised_rows(lower))
            values["pcc4_all_pixels"] = dot_rows(whole, standardised_rows(np.where(seen, moved, 0.0)))
        for ending in ("", "_all_pixels") if all_pixels else ("",):
            both = values[f"pcc3{ending}"] + values[f"pcc4{ending}"]
            for measure in (f"pcc3{ending}", f"pcc4{ending}"):
                values[measure] = np.where(np.isnan(both), np.nan, values[measure])
        values["pcc4_minus_pcc3"] = values["pcc4"] - values["pcc3"]
        for measure, measured in values.items():
            names = {"task": "navigate", "kind": kind, "map": name, "measure": measure}
            tables.append(_table(names, measured, targets.pair_ids, targets.scene_ids))
    return pd.concat(tables, ignore_index=True)


def _mean_defined(values: Array, wanted: NDArray[np.bool_]) -> Array:
    """Mean (N,) of the `wanted` values in each row of values (N, M), without NaN; NaN if no value remains."""
    used = wanted & ~np.isnan(values)
    counts = used.sum(1)
    return np.where(counts > 0, np.where(used, values, 0.0).sum(1) / np.maximum(counts, 1), np.nan)


def _table(names: dict[str, str], values: Array, ids: Sequence[str], scenes: Sequence[str]) -> pd.DataFrame:
    """Rows of the long table for one measure of one map; `names` has the columns that are equal in all rows."""
    if not len(values) == len(ids) == len(scenes):
        raise ValueError(f"{len(values)} maps, {len(ids)} frame names and {len(scenes)} scene names")
    varying = {"frame_id": list(ids), "scene_id": list(scenes), "value": np.asarray(values, np.float64)}
    return pd.DataFrame(names | varying, columns=list(COLUMNS))
