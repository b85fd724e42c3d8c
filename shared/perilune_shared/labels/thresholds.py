"""Named sets of label thresholds: from all craters in the frame to those visible in the image.

This module does not import pandas and pyarrow, so that configurations and `--help` load quickly.
`perilune_shared.labels.selection` applies the thresholds.
"""

from typing import Annotated

from pydantic import Field

from perilune_shared.config.resolve import Section

Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0, le=1e9)]


class Selection(Section):
    """Thresholds of a selection; a selected label fulfils all of them. null sets no threshold."""

    radius_px: tuple[Positive, Positive | None] | None = None
    """Minimum and maximum radius sqrt(a b), pixels; null as the maximum sets no upper limit."""
    min_visible_fraction: Share | None = None
    """Minimum fraction of the rim that is inside the image and not hidden."""
    min_sunlit_fraction: Share | None = None
    """Minimum fraction of the crater's visible pixels that are in sunlight."""
    min_depth_ratio: Share | None = None
    """Minimum ratio of depth to diameter on the finished terrain; lower ratios mean an eroded crater."""
    min_contrast: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    """Minimum contrast: the shading of the crater itself in the frame, divided by its standard error from noise and
    clutter."""
    contrast_pixels: Positive | None = None
    """Maximum number of pixels that count as independent in the contrast. In a larger neighbourhood the contrast is
    divided by the square root of the ratio, since neighbouring pixels of a blurred, cluttered frame are alike. null
    counts all."""


SELECTIONS: dict[str, Selection] = {
    "all": Selection(),
    "paper": Selection(radius_px=(2.0, 50.0)),
    "visible": Selection(
        radius_px=(2.0, None),
        min_visible_fraction=0.3,
        min_sunlit_fraction=0.1,
        min_depth_ratio=0.04,
        min_contrast=5.0,
        contrast_pixels=250.0,
    ),
}
"""`all`: every label. `paper`: the paper's rule, radius 2 to 50 px and centre in the frame (true of every label).
`visible`: craters above a threshold of contrast, for training and evaluation (docs/explanation/labels.md)."""


REACH_RADII = 1.5
"""The contrast is measured within this distance of the crater's centre, in radii."""


def default_label_bound_px(width_px: int) -> float:
    """Return the default maximum radius of a label, pixels: 50 up to 256 px width, proportional to the width above."""
    return max(50.0, width_px * 50 / 256)
