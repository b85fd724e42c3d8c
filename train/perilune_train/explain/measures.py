"""PCC1 to PCC4 of the paper, for each block, from attention masks."""

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.frames import Array
from perilune_train.explain.correlation import mean_between, mean_defined, pearson, pearson_between, warped_mask
from perilune_train.explain.masks import Masks

PCC1_SIGN = (
    "G is 1 on background and 0 in craters: pcc1_background above 0 means that the gate is weaker on craters; "
    "pcc1_craterness is the correlation with 1 - G, of the opposite sign"
)


def detector_correlations(masks: Masks, truth: NDArray[np.floating]) -> list[dict]:
    """Rows of PCC1 and PCC2 for every block; `truth` (N, height, width) are the paper's masks G of the N frames.

    pcc1_background is the paper's PCC1, the correlation with G, which is 1 on background: above 0 the gate is weaker on
    craters. pcc1_craterness is the correlation with 1 - G: above 0 the gate is stronger on craters. pcc2 is the
    correlation of one block's masks of different frames.
    """
    rows = []
    for block, found in masks.items():
        for measure, target in (("pcc1_background", truth), ("pcc1_craterness", 1 - truth)):
            values = [pearson(mask, one) for mask, one in zip(found, target, strict=True)]
            rows.append(_row(block, measure, *mean_defined(values), len(found)))
        rows.append(_row(block, "pcc2", *mean_between(pearson_between(found)), len(found) * (len(found) - 1)))
    return rows


def pair_correlations(mask: NDArray[np.floating], affine: Array) -> dict[str, float]:
    """pcc3 and pcc4 of one stacked mask (2 height, width), both over the overlap, and both over all pixels.

    `affine` (2, 3) maps image coordinates of the upper, earlier frame to those of the lower one. The overlap is the
    part of the upper frame that is in the lower one. The paper uses all pixels, at least for PCC3, and does not define
    the moved mask outside the overlap; it is 0 here, OpenCV's default. If one half is constant, both values of that
    kind (overlap or all pixels) are NaN, because their means must be over the same pairs.
    """
    upper, lower = np.split(np.asarray(mask, np.float64), 2)
    moved, seen = warped_mask(lower, affine)
    values = {
        "pcc3": pearson(upper, lower, seen),
        "pcc4": pearson(upper, moved, seen),
        "pcc3_all_pixels": pearson(upper, lower),
        "pcc4_all_pixels": pearson(upper, np.where(seen, moved, 0.0)),
    }
    for ending in ("", "_all_pixels"):
        if np.isnan([values[f"pcc3{ending}"], values[f"pcc4{ending}"]]).any():
            values |= {f"pcc3{ending}": np.nan, f"pcc4{ending}": np.nan}
    return values


def navigator_correlations(block: str, masks: NDArray[np.floating], affines: list[Array]) -> list[dict]:
    """Rows of PCC3 and PCC4 for one block with masks (N, 2 height, width) and an affine map for each pair."""
    values = [pair_correlations(mask, affine) for mask, affine in zip(masks, affines, strict=True)]
    rows = []
    for measure in ("pcc3", "pcc4"):
        everywhere, _ = mean_defined([one[f"{measure}_all_pixels"] for one in values])
        rows.append(_row(block, measure, *mean_defined([one[measure] for one in values]), len(values), everywhere))
    return rows


def _row(block: str, measure: str, value: float, undefined: int, count: int, all_pixels: float = np.nan) -> dict:
    return {
        "block": block,
        "measure": measure,
        "value": value,
        "value_all_pixels": all_pixels,
        "undefined": undefined,
        "count": count,
    }
