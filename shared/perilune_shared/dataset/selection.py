"""Which labels count: named selections of craters, from all that lie in the frame to those that a picture shows.

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
    """Thresholds that a label must all reach; null asks for nothing."""

    radius_px: tuple[Positive, Positive | None] | None = None
    """Least and largest sqrt(a b), pixels; null as the largest asks for none."""
    min_visible_fraction: Share | None = None
    """Least share of the rim that lies inside the image and is not hidden."""
    min_sunlit_fraction: Share | None = None
    """Least share of the crater's pixels that the Sun reaches."""
    min_depth_ratio: Share | None = None
    """Least depth over diameter, on the finished terrain: below it a crater is worn away."""
    min_contrast: float | None = None
    """Least contrast: the crater's own shading in the frame over its standard error, from noise and clutter."""


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
"""Every label of a dataset; the paper's rule, 2 to 50 px with the centre in the frame (as is that of every label); and
what somebody who looks at the frame could find, for training and scoring."""
_JUDGED = ["radius_px", "visible_fraction", "sunlit_fraction", "contrast"]
_CRATER = ["scene_id", "crater_id", "depth_m", "diameter_m"]


def selected(labels: pd.DataFrame, selection: Selection) -> NDArray[np.bool_]:
    """Whether each label (N,) is selected, from radius_px, visible_fraction, sunlit_fraction, contrast, depth_m and
    diameter_m (see `read_labels`). A contrast that is not known (NaN: migrated datasets) is not asked for; any other
    value that is not known reaches no threshold."""
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
    """Largest radius that becomes a label by default, pixels: 50, and in images wider than 256 px in proportion."""
    return max(50.0, width_px * 50 / 256)


def label_bound_px(info: DatasetInfo) -> float:
    """Largest radius that became a label in a dataset, pixels, by its recipes; the default where they do not say."""
    stated = [recipe.config.get("labels") for recipe in info.recipes.values()]
    bounds = [labels.get("max_radius_px") for labels in stated if isinstance(labels, dict)]
    numbers = [float(bound) for bound in bounds if isinstance(bound, int | float) and bound > 0]
    return max(numbers, default=default_label_bound_px(info.camera.width_px))


def read_labels(dataset: Dataset, columns: Sequence[str] = (), split: str | None = None) -> pd.DataFrame:
    """Labels of a dataset or of one split with all that `selected` asks for, and further `columns` of the table.

    In the table's order. Depth and diameter (metres) are those of the table craters, joined by scene_id and crater_id.
    Raises UserError where a part cannot be read or keys are broken.
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
