"""Select labels by named sets of thresholds: from all craters in the frame to those visible in the image.

Use::

    labels = read_labels(dataset, split="test")
    seen = labels[selected(labels, SELECTIONS["visible"])]
"""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from perilune_shared.config import Section
from perilune_shared.dataset.keys import FRAME_COLUMNS, KeyCheck
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo

Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]


class Selection(Section):
    """Thresholds; a selected label fulfils all of them. null sets no threshold."""

    radius_px: tuple[Positive, Positive | None] | None = None
    """Minimum and maximum radius sqrt(a b), pixels; null as the maximum sets no upper limit."""
    min_visible_fraction: Share | None = None
    """Minimum fraction of the rim that is inside the image and not hidden."""
    min_sunlit_fraction: Share | None = None
    """Minimum fraction of the crater's visible pixels that are in sunlight."""
    min_depth_ratio: Share | None = None
    """Minimum ratio of depth to diameter on the finished terrain; lower ratios mean an eroded crater."""
    min_contrast: float | None = None
    """Minimum contrast: the crater's own shading in the frame divided by its standard error, from noise and clutter."""


SELECTIONS: dict[str, Selection] = {
    "all": Selection(),
    "paper": Selection(radius_px=(2.0, 50.0)),
    "visible": Selection(
        radius_px=(2.0, None),
        min_visible_fraction=0.3,
        min_sunlit_fraction=0.1,
        min_depth_ratio=0.04,
        min_contrast=4.0,
    ),
}
"""`all`: every label. `paper`: the paper's rule, radius 2 to 50 px and centre in the frame (true of every label).
`visible`: craters that a person can see in the frame, for training and evaluation."""
_JUDGED = ["radius_px", "visible_fraction", "sunlit_fraction", "contrast"]
_CRATER = ["scene_id", "crater_id", "depth_m", "diameter_m"]


def selected(labels: pd.DataFrame, selection: Selection) -> NDArray[np.bool_]:
    """Return whether each label (N,) is selected.

    Needs the columns radius_px, visible_fraction, sunlit_fraction, contrast, depth_m and diameter_m (see
    `read_labels`). An unknown contrast (NaN, in migrated datasets) passes; any other unknown value fails its threshold.
    """
    chosen = np.ones(len(labels), np.bool_)
    if selection.radius_px is not None:
        least_px, largest_px = selection.radius_px
        chosen &= labels["radius_px"].between(least_px, np.inf if largest_px is None else largest_px).to_numpy()
    for column in ("visible_fraction", "sunlit_fraction", "contrast"):
        least = getattr(selection, f"min_{column}")
        if least is not None:
            values = labels[column].to_numpy()
            chosen &= (values >= least) | (np.isnan(values) & (column == "contrast"))
    if selection.min_depth_ratio is not None:
        chosen &= labels["depth_m"].to_numpy() >= selection.min_depth_ratio * labels["diameter_m"].to_numpy()
    return chosen


def default_label_bound_px(width_px: int) -> float:
    """Default maximum radius of a label, pixels: 50, and proportional to the width in images wider than 256 px."""
    return max(50.0, width_px * 50 / 256)


def label_bound_px(info: DatasetInfo) -> float:
    """Maximum radius of a label in a dataset, pixels, from its recipes; the default if they do not state it."""
    stated = [recipe.config.get("labels") for recipe in info.recipes.values()]
    bounds = [labels.get("max_radius_px") for labels in stated if isinstance(labels, dict)]
    numbers = [float(bound) for bound in bounds if isinstance(bound, int | float) and bound > 0]
    return max(numbers, default=default_label_bound_px(info.camera.width_px))


def read_labels(dataset: Dataset, columns: Sequence[str] = (), split: str | None = None) -> pd.DataFrame:
    """Read the labels of a dataset or of one split, with the columns that `selected` needs and further `columns`.

    Rows are in the order of the table labels. Depth and diameter (metres) come from the table craters, joined by
    scene_id and crater_id. Raises UserError if a part cannot be read or keys are broken.
    """
    wanted = list(dict.fromkeys(["frame_id", "crater_id", *_JUDGED, *columns]))
    frames = dataset.table("frames", ["frame_id", "scene_id"], split=split).to_pandas()
    rows = dataset.table("labels", wanted)
    keys = KeyCheck(dataset, dataset.table("frames", FRAME_COLUMNS))
    keys.add_labels(rows)
    keys.finish()
    labels = rows.to_pandas().merge(frames, on="frame_id", validate="many_to_one")
    craters = dataset.table("craters", _CRATER).to_pandas()
    return labels.merge(craters, on=["scene_id", "crater_id"], how="left", validate="many_to_one")
