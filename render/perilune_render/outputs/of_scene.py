"""The outputs that a configuration requests in addition to the frames of one lit scene."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.config.outputs import FlashLidarConfig
from perilune_render.engines.frame_source import Frame
from perilune_render.engines.heightfield.surface import Surface, surface_of
from perilune_render.outputs.flash_lidar import flash
from perilune_render.outputs.hazard import HazardMap, hazard_map
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.frames import Array


@dataclass(frozen=True, slots=True)
class FrameOutputs:
    """Outputs of a frame in addition to its rendering."""

    channels: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Additional EXR channels (h, w), in the pixels of the engine's camera."""
    lidar: bytes | None = None
    """Content of the flash lidar's EXR file; None without a flash lidar."""


@dataclass(frozen=True, slots=True)
class SceneOutputs:
    """The additional outputs of one lit scene. Create it with `SceneOutputs.of`."""

    surface: Surface | None = None
    """Surface of the scene; None if no output needs it."""
    hazard: HazardMap | None = None
    """Hazard map of the scene; None if no map is requested."""
    has_channels: bool = False
    """Whether the EXRs have channels from the hazard map."""
    flash_lidar: FlashLidarConfig | None = None
    """Settings of the flash lidar; None without a flash lidar."""

    @classmethod
    def of(cls, scene: Scene, config: DatasetConfig, sun: Array) -> "SceneOutputs":
        """The outputs of a scene lit from `sun` (3,), a unit vector in O_L."""
        if config.hazard is None and config.flash_lidar is None:
            return cls()
        surface = surface_of(scene)
        if config.hazard is None:
            return cls(surface, flash_lidar=config.flash_lidar)
        hazard = hazard_map(surface, scene, sun, config.hazard)
        return cls(surface, hazard, config.hazard.frame_channels, config.flash_lidar)

    def of_frame(self, frame: Frame, places_m: Callable[[Frame], Array]) -> FrameOutputs:
        """The additional outputs of a frame; `places_m` is `FrameSource.places_m` of its frame source."""
        channels: Mapping[str, np.ndarray] = {}
        if self.hazard is not None and self.has_channels:
            points = places_m(frame)
            channels = self.hazard.at(points[..., 0], points[..., 1])
        if self.surface is None or self.flash_lidar is None:
            return FrameOutputs(channels)
        return FrameOutputs(channels, flash(self.surface, frame.shot, self.flash_lidar).exr())
