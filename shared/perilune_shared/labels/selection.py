"""Read labels and select them by the thresholds of `perilune_shared.labels.thresholds`.

Use:

    labels = read_labels(dataset, split="test")
    seen = labels[selected(labels, SELECTIONS["visible"])]
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from numpy.typing import NDArray

from perilune_shared.dataset.keys import FRAME_COLUMNS, KeyCheck
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.labels.thresholds import REACH_RADII, Selection, default_label_bound_px

_THRESHOLDED = ["radius_px", "visible_fraction", "sunlit_fraction", "contrast"]
Columns = pd.DataFrame | Mapping[str, NDArray]
_CRATER = ["scene_id", "crater_id", "depth_m", "diameter_m"]


def selected(labels: Columns, selection: Selection) -> NDArray[np.bool_]:
    """Return whether each label is in a selection, bool (N,).

    Needs the columns radius_px, visible_fraction, sunlit_fraction, contrast, depth_m and diameter_m (see
    `read_labels`). A label without a known contrast (NaN, in migrated datasets) passes the threshold of contrast. A
    label without another value fails the threshold of this value.
    """
    radius_px = np.asarray(labels["radius_px"])
    chosen = np.ones(len(radius_px), np.bool_)
    if selection.radius_px is not None:
        min_px, max_px = selection.radius_px
        chosen &= (radius_px >= min_px) & (radius_px <= (np.inf if max_px is None else max_px))
    for column in ("visible_fraction", "sunlit_fraction"):
        minimum = getattr(selection, f"min_{column}")
        if minimum is not None:
            chosen &= np.asarray(labels[column]) >= minimum
    if selection.min_contrast is not None:
        contrast = limited_contrast(np.asarray(labels["contrast"]), radius_px, selection.contrast_pixels)
        chosen &= (contrast >= selection.min_contrast) | np.isnan(contrast)
    if selection.min_depth_ratio is not None:
        chosen &= np.asarray(labels["depth_m"]) >= selection.min_depth_ratio * np.asarray(labels["diameter_m"])
    return chosen


def limited_contrast(contrast: NDArray, radius_px: NDArray, pixels: float | None) -> NDArray:
    """Return the contrast (N,) of labels, computed as if from at most `pixels` independent pixels.

    `radius_px` (N,) determines how many pixels are around each crater. `pixels` None sets no limit.
    """
    if pixels is None:
        return contrast
    around = np.pi * (REACH_RADII * radius_px) ** 2
    return contrast * np.sqrt(np.minimum(1.0, pixels / np.maximum(around, 1e-9)))


def label_bound_px(info: DatasetInfo) -> float:
    """Return a dataset's maximum label radius, pixels.

    It is the largest `labels.max_radius_px` of the recipes, or the default for the widest camera if no recipe sets it.
    """
    stated = [recipe.config.get("labels") for recipe in info.recipes.values()]
    bounds = [labels.get("max_radius_px") for labels in stated if isinstance(labels, dict)]
    numbers = [float(bound) for bound in bounds if isinstance(bound, int | float) and bound > 0]
    widths = [camera.width_px for camera in (info.cameras or {"": info.camera}).values()]
    return max(numbers, default=default_label_bound_px(max(widths)))


def read_labels(dataset: Dataset, columns: Sequence[str] = (), split: str | None = None) -> pd.DataFrame:
    """Return the labels of one split or all, with the columns that `selected` needs and `columns`.

    Rows are in the order of the table `labels`. Depth and diameter (metres) come from the table `craters`, joined by
    scene_id and crater_id. Raises UserError if a part cannot be read, or if keys of labels and frames are inconsistent.
    """
    names = list(dict.fromkeys(["frame_id", "scene_id", "crater_id", *_THRESHOLDED, *columns]))
    rows = dataset.table("labels", list(dict.fromkeys([*names, "split"])))
    keys = KeyCheck(dataset, dataset.table("frames", FRAME_COLUMNS))
    keys.add_labels(rows)
    keys.finish()
    if split is not None:
        rows = rows.filter(pc.equal(rows["split"], split))
    labels = rows.select(names).to_pandas()
    craters = dataset.table("craters", _CRATER).to_pandas()
    return labels.merge(craters, on=["scene_id", "crater_id"], how="left", validate="many_to_one")
