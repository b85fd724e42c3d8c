"""Settings for cutting images into tiles."""

from dataclasses import dataclass

from perilune_shared.errors import UserError
from perilune_train.detect.config import COARSEST_STRIDE


@dataclass(frozen=True)
class Tiling:
    """How to cut an image into tiles, and the margin of the boxes."""

    tile_px: int = 256
    """Side of a tile, pixels; by default the side of the training frames."""
    overlap_px: int = 64
    """Minimum overlap of two neighbouring tiles, pixels: craters up to this size are whole in at least one tile."""
    scales: tuple[float, ...] = (1.0,)
    """Factors by which the image is resized before it is cut; detections at all scales are merged. Use factors above 1
    for craters smaller than those in training, and factors below 1 for larger craters."""
    box_margin_px: float = 0.0
    """Margin added to the detected boxes at every side, pixels. The detector's boxes end at the crest of the rim, with
    subpixel accuracy. The smallest box of whole pixels around a crater is on average half a pixel larger at every
    side."""

    def check(self) -> None:
        """Raise UserError on unusable values."""
        if self.tile_px < COARSEST_STRIDE or self.tile_px % COARSEST_STRIDE:
            raise UserError("--tile", "", self.tile_px, f"a multiple of {COARSEST_STRIDE}")
        if not 0 <= self.overlap_px < self.tile_px:
            raise UserError("--overlap", "", self.overlap_px, f"0 to {self.tile_px - 1}, less than a tile")
        if not self.scales or not all(0.05 <= scale <= 8 for scale in self.scales):
            raise UserError("--scale", "", list(self.scales), "0.05 to 8")
        if not 0 <= self.box_margin_px <= 10:
            raise UserError("--box-margin", "", self.box_margin_px, "0 to 10")
