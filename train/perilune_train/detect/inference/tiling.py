"""Settings for cutting images into tiles."""

from collections import Counter
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
    scales: tuple[float, ...] | None = (1.0,)
    """Factors by which the image is resized before it is cut; detections at all scales are merged. Use factors above 1
    for craters smaller than those in training, and factors below 1 for larger craters. None: a pyramid that depends on
    the size of each image (`pyramid`)."""
    box_margin_px: float = 0.0
    """Margin added to the detected boxes at every side, pixels. The detector's boxes end at the crest of the rim, with
    subpixel accuracy. The smallest box of whole pixels around a crater is on average half a pixel larger at every
    side."""
    finest: float = 1.0
    """Finest scale of the pyramid."""
    min_coarse_radius_px: float = 0.0
    """Minimum radius sqrt(w h) / 2 of a box in a reduced image (scale below 1), in pixels of the reduced image, if
    detection also runs at a finer scale. The finer scale finds smaller craters better, and reduced images add false
    positives of a few pixels."""

    def scales_of(self, height_px: int, width_px: int) -> tuple[float, ...]:
        """Scales for an image of this size, the finest first if they are a pyramid."""
        return pyramid(height_px, width_px, self.tile_px, self.finest) if self.scales is None else self.scales

    def check(self) -> None:
        """Raise UserError on unusable values."""
        if self.tile_px < COARSEST_STRIDE or self.tile_px % COARSEST_STRIDE:
            raise UserError("--tile", "", self.tile_px, f"a multiple of {COARSEST_STRIDE}")
        if not 0 <= self.overlap_px < self.tile_px:
            raise UserError("--overlap", "", self.overlap_px, f"0 to {self.tile_px - 1}, less than a tile")
        if self.scales is not None and not (self.scales and all(0.05 <= scale <= 8 for scale in self.scales)):
            raise UserError("--scale", "", list(self.scales), "0.05 to 8")
        if not 0 <= self.box_margin_px <= 10:
            raise UserError("--box-margin", "", self.box_margin_px, "0 to 10")


def pyramid(height_px: int, width_px: int, tile_px: int, finest: float = 1.0) -> tuple[float, ...]:
    """Scales for an image of any size: `finest`, half of it, ... down to the whole shorter side in half a tile.

    At the coarsest scale, a crater as wide as the image has a radius of at most a quarter of a tile. All coarser scales
    together cost a third of the finest.
    """
    scales = [finest]
    while min(height_px, width_px) * scales[-1] > tile_px / 2:
        scales.append(scales[-1] / 2)
    return tuple(scales)


def described(scales: tuple[float, ...]) -> str:
    """Scales as text, such as `1, 1/2, 1/4`."""
    return ", ".join(
        f"1/{1 / scale:.0f}" if scale < 1 and (1 / scale).is_integer() else f"{scale:g}" for scale in scales
    )


def described_by_image(every: list[tuple[float, ...]]) -> str:
    """The scales of several images as text, such as `1, 1/2 (3 images); 1, 1/2, 1/4 (2 images)`."""
    counts = Counter(every)
    if len(counts) == 1:
        return described(every[0])
    return "; ".join(f"{described(scales)} ({count} image{'s' * (count > 1)})" for scales, count in counts.items())
