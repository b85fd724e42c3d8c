"""Measure how well maps locate craters: pointing game, relevance mass and ROC-AUC, with chance levels."""

from collections.abc import Mapping

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_train.explain.correlation.pearson import is_constant

MEASURES = ("auc", "relevance_mass", "pointing")
"""Measures in which gates are tested against nulls."""
TOLERANCE_PX = 3
"""Largest distance, pixels, from a crater pixel at which the top pixel of a map counts as a hit."""


def localisation(
    maps: Mapping[str, NDArray[np.floating]],
    craters: NDArray[np.bool_],
    sign: Mapping[str, int],
    frames: pd.DataFrame,
    task: str,
    kind: str,
) -> pd.DataFrame:
    """Long table of how well each map (N, height, width) locates the crater pixels (N, height, width).

    `sign` is 1, or -1 for a map that is weaker on craters; determine the sign on validation frames. `frames` has the
    columns frame_id and scene_id in the order of the maps. Columns of the table: task, kind, map, measure, frame_id,
    scene_id, value. `localised` defines the measures. Values are NaN where the map is constant, or where no pixel or
    every pixel is in a crater.
    """
    rows, nearby = [], [within(inside, TOLERANCE_PX) for inside in craters]
    for name, images_map in maps.items():
        for i, (image_map, inside, near) in enumerate(zip(images_map, craters, nearby, strict=True)):
            values = localised(sign[name] * image_map.astype(np.float64), inside, near)
            frame = {"frame_id": frames["frame_id"].iloc[i], "scene_id": frames["scene_id"].iloc[i]}
            rows += [{"map": name, "measure": measure, **frame, "value": value} for measure, value in values.items()]
    table = pd.DataFrame(rows, columns=["map", "measure", "frame_id", "scene_id", "value"])
    table.insert(0, "task", task)
    table.insert(1, "kind", kind)
    return table


def localised(
    relevance: NDArray[np.floating], craters: NDArray[np.bool_], near: NDArray[np.bool_] | None = None
) -> dict[str, float]:
    """Localisation measures of one map (height, width), from the crater pixels (height, width).

    The map must be larger on craters. `near` (height, width) are the pixels within TOLERANCE_PX of a crater pixel;
    pass them to compare several maps with the same craters.

    - pointing: 1 if the map's largest pixel is within TOLERANCE_PX of a crater, else 0 (Zhang et al. 2018, doi
      10.1007/s11263-017-1059-x). If several pixels are largest: the share of these pixels that are hits.
    - pointing_chance: share of the image area within TOLERANCE_PX of craters.
    - relevance_mass: share of the map, shifted to minimum 0, within craters (Arras et al. 2022, doi
      10.1016/j.inffus.2021.11.008).
    - relevance_mass_chance: share of the image area in craters.
    - auc: probability that a crater pixel has a larger value than a pixel outside craters; ties count half. The chance
      level is 0.5.
    """
    near = within(craters, TOLERANCE_PX) if near is None else near
    if is_constant(relevance) or craters.all() or not craters.any():
        names = ("pointing", "relevance_mass", "auc", "pointing_chance", "relevance_mass_chance")
        return dict.fromkeys(names, float("nan"))
    shifted = relevance - relevance.min()
    return {
        "pointing": float(near[relevance == relevance.max()].mean()),
        "relevance_mass": float(shifted[craters].sum() / shifted.sum()),
        "auc": area_under_curve(relevance, craters),
        "pointing_chance": float(near.mean()),
        "relevance_mass_chance": float(craters.mean()),
    }


def within(craters: NDArray[np.bool_], distance_px: float) -> NDArray[np.bool_]:
    """Pixels (height, width) whose centre is within a distance of the centre of a crater pixel."""
    if not craters.any():
        return craters
    distance = cv2.distanceTransform((~craters).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance <= distance_px)


def area_under_curve(relevance: NDArray[np.floating], craters: NDArray[np.bool_]) -> float:
    """ROC-AUC of the pixels by the Mann-Whitney statistic; ties count half."""
    inside, outside = np.sort(relevance[craters]), np.sort(relevance[~craters])
    # Of a crater pixel, twice the number of smaller outer pixels plus the number of equal ones.
    reached = np.searchsorted(outside, inside, "left") + np.searchsorted(outside, inside, "right")
    return float(reached.sum() / (2 * len(inside) * len(outside)))
