"""Named sets of label thresholds: from all craters in the frame to those above a threshold of contrast.

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
    """Maximum number of pixels around a crater that count as independent in the contrast. If there are k times as many
    pixels, the contrast is divided by the square root of k, since neighbouring pixels of a blurred, cluttered frame are
    alike. null: all pixels count."""


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
"""`all`: every label. `paper`: the paper's rule, radius 2 to 50 px and centre in the frame (every label's centre is).
`visible`: craters above the contrast at which a detector found about half of them, for training and evaluation. It is
no statement about human observers (docs/explanation/labels.md)."""


REACH_RADII = 1.5
"""Distance from the crater's centre within which the contrast is measured, in radii."""


def default_label_bound_px(width_px: int) -> float:
    """Return the default maximum radius of a label in an image of a given width, pixels.

    It is 50 px up to a width of 256 px, and proportional to the width of wider images.
    """
    return max(50.0, width_px * 50 / 256)
