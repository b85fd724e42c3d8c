"""Settings of datasets that are derived from another dataset: surveys and counterfactuals."""

from typing import Annotated

from pydantic import Field

from perilune_render.config.values import Altitude
from perilune_shared.config.resolve import Section

SceneSeed = Annotated[int, Field(ge=0, lt=2**63)]
CraterId = Annotated[int, Field(ge=0, lt=2**31)]


class SurveyConfig(Section):
    """Images of another dataset's terrain from orbit, to map its craters before a landing.

    Each scene gets one pair of images from equal heights: one from west and one from east of the site.
    """

    altitude_m: Altitude = 4500.0
    """Height of both cameras above the site, metres."""
    pixel_m: Annotated[float, Field(gt=0, le=1000)] = 0.6
    """Size of a pixel on level ground straight below the camera, metres."""
    convergence_deg: Annotated[float, Field(ge=5, le=60)] = 30.0
    """Angle between the camera axes, degrees. A wider angle gives more accurate heights but less overlap."""
    sun_azimuth_offset_deg: Annotated[float, Field(ge=-180, le=180)] = 90.0
    """Azimuth of the Sun, clockwise from the Sun's azimuth in the other dataset, degrees."""
    sun_elevation_deg: Annotated[float, Field(gt=0, le=90)] = 30.0
    """Elevation of the Sun, degrees."""


class CounterfactualConfig(Section):
    """The frames of another dataset with changed ground or light.

    Poses, noise and all other ground are unchanged.
    """

    removed: dict[SceneSeed, tuple[CraterId, ...]] = Field(default_factory=dict)
    """Craters to remove or to make shallower: a list of `crater_id` for the random seed of each scene."""
    depth_share: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the depth that remains; 0 removes the craters, with their rays and boulders."""
    sun_azimuth_offset_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """Azimuth of the Sun, clockwise from the Sun's azimuth in the other dataset, degrees."""
