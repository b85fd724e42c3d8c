"""Settings of one scene whose poses come from a file or from a client."""

from typing import Annotated

from pydantic import Field, model_validator

from perilune_shared.config.resolve import Section

HIGHEST_M = 20_000.0
"""Largest height of a camera in a scene with horizon, metres. It limits the extent of the ground."""


class ViewConfig(Section):
    """The extent of the ground that cameras at one height see."""

    height_m: Annotated[float, Field(gt=0, le=2e6)]
    """Height of a camera above the ground, metres."""
    reach_m: Annotated[float, Field(gt=0, le=2e6)]
    """Largest |x| or |y| of the ground that cameras up to this height show, metres. With `horizon`, it is the largest
    |x| or |y| of the cameras."""


class SceneConfig(Section):
    """One scene with given poses, in place of drawn scenes and descents."""

    sun_azimuth_deg: Annotated[float, Field(ge=-720, le=720)] = 90.0
    """Azimuth of the Sun, clockwise from north, degrees; a column of the file of poses overrides it."""
    sun_elevation_deg: Annotated[float, Field(gt=0, le=90)] = 30.0
    """Elevation of the Sun above the ground plane, degrees; a column of the file of poses overrides it."""
    views: tuple[ViewConfig, ...] = ()
    """Views for which the ground is made, from the lowest to the highest. They determine the extent of the ground and
    its vertex spacing at each distance from the site. By default, they are derived from the poses."""
    horizon: bool = False
    """Whether frames may show the sky. The ground is then curved and extends to the horizon of a camera at the height
    of the last view."""
    poses_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """SHA-256 of the poses; `perilune-render frames` sets it to prevent resuming a dataset with other poses."""

    @model_validator(mode="after")
    def _views_ascend(self) -> "SceneConfig":
        for low, high in zip(self.views, self.views[1:], strict=False):
            if high.height_m <= low.height_m or high.reach_m < low.reach_m:
                raise ValueError("views with ascending height_m, and reach_m that does not decrease")
        if self.horizon and self.views and self.views[-1].height_m > HIGHEST_M:
            raise ValueError(f"height_m of at most {HIGHEST_M:g}, since horizon is true")
        return self
