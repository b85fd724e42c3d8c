"""Settings of a counterfactual: the frames of another dataset, with changed ground or light and all else equal."""

from typing import Annotated

from pydantic import Field

from perilune_shared.config.resolve import Section

SceneSeed = Annotated[int, Field(ge=0, lt=2**63)]
CraterId = Annotated[int, Field(ge=0, lt=2**31)]


class CounterfactualConfig(Section):
    """Changes of the scenes of another dataset. Poses, noise and all other ground stay as they are."""

    removed: dict[SceneSeed, tuple[CraterId, ...]] = Field(default_factory=dict)
    """Craters that are removed from the ground, as crater_id, by the random seed of their scene."""
    sun_azimuth_offset_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """Azimuth of the Sun, relative to that of the other dataset, clockwise, degrees."""
