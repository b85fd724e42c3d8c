"""Settings of additional outputs: hazard maps of the scenes and images of a flash lidar."""

from typing import Annotated

from pydantic import Field, model_validator

from perilune_render.config.values import Deviation, Length, Share
from perilune_shared.config.resolve import Section

_MIN_PX, _MAX_PX = 3, 100
"""Smallest and largest footprint, pixels: fitting a plane needs 3, and run time grows with its square."""
_MAX_SIDE_PX = 2048
_ROUNDING = 1e-9


class HazardConfig(Section):
    """A hazard map of each scene: slope, roughness, boulders, shadow and safe places for a lander."""

    footprint_m: Length = 10.0
    """Diameter of the lander's footprint, metres."""
    pixel_m: Length = 0.5
    """Size of a pixel of the map, metres."""
    extent_m: Length = 200.0
    """Side of the square map, centred on the site, metres."""
    max_slope_deg: Annotated[float, Field(gt=0, lt=90)] = 10.0
    """Largest slope of a safe place, degrees."""
    max_roughness_m: Deviation = 0.5
    """Largest roughness of a safe place (deviation of the surface from a plane fitted to the footprint), metres."""
    max_boulder_m: Deviation = 0.5
    """Largest boulder height at a safe place, metres."""
    max_shadow_share: Share = 1.0
    """Largest share of a safe place that may lie in shadow; 1 for no limit."""
    frame_channels: bool = False
    """Whether the EXRs also have the channels slope, roughness, boulder and safe, sampled from the map."""

    @model_validator(mode="after")
    def _of_pixels(self) -> "HazardConfig":
        if not _MIN_PX <= self.footprint_m / self.pixel_m * (1 + _ROUNDING) <= _MAX_PX:
            raise ValueError(f"footprint_m of {_MIN_PX} to {_MAX_PX} pixel_m, which is {self.pixel_m:g}")
        if not 1 <= self.side_px() <= _MAX_SIDE_PX:
            raise ValueError(f"extent_m of 1 to {_MAX_SIDE_PX} pixel_m, which is {self.pixel_m:g}")
        return self

    def side_px(self) -> int:
        """Side of the map, pixels."""
        return int(self.extent_m / self.pixel_m * (1 + _ROUNDING))

    def margin_px(self) -> int:
        """Width of the border around the map into which footprints at its edge extend, pixels."""
        return int(self.footprint_m / self.pixel_m / 2 * (1 + _ROUNDING))


class FlashLidarConfig(Section):
    """A flash lidar along the camera's axis, which measures all pixels at the time of each frame."""

    width_px: Annotated[int, Field(ge=1, le=1024)] = 128
    """Image width, pixels."""
    height_px: Annotated[int, Field(ge=1, le=1024)] = 128
    """Image height, pixels."""
    horizontal_fov_deg: Annotated[float, Field(ge=0.1, le=120)] = 20.0
    """Horizontal field of view, degrees; the principal point is the image centre."""
    range_sigma_m: Deviation = 0.05
    """Standard deviation of a range at distance 0, metres."""
    range_sigma_share: Share = 0.0
    """Standard deviation that is added in proportion to the range, share of the range."""
    quantisation_m: Deviation = 0.01
    """Step to which ranges are rounded, metres; 0 for no rounding."""
    max_range_m: Length = 2000.0
    """Largest range that the lidar measures, metres."""
    threshold_range_m: Length = 1500.0
    """Largest distance at which ground of mean albedo, seen along its normal, returns enough energy to be detected,
    metres."""
    energy_sigma_share: Annotated[float, Field(ge=0, le=1)] = 0.1
    """Standard deviation of the returned energy, share of the energy."""
    false_return_share: Share = 0.0
    """Share of pixels with a false return: its range is drawn evenly from 0 to max_range_m."""
