"""Radiance: the rendering of one frame, from which the sensor makes the image."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Radiance:
    """Rendering of one frame, before the sensor model."""

    radiance_factor: np.ndarray
    """Radiance factor I/F (h, w) float32."""
    depth_m: np.ndarray
    """Depth, along the camera's axis, of the hit of the ray through the pixel's centre, metres; infinite without a hit
    (h, w) float32."""
    normal: np.ndarray
    """Unit shading normal in O_L, 0 without a hit (h, w, 3) float32. With dataset.render.exr it is the normal at the
    hit of the ray through the pixel's centre, otherwise the mean direction over the pixel's samples."""
    sunlit: np.ndarray
    """Whether the pixel is sunlit (h, w) bool."""
    blurred: np.ndarray | None = None
    """Mean radiance factor over the exposure (h, w) float32, if several poses were rendered; not in an EXR."""

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> "Radiance":
        """A rendering (h, w) whose values are not set yet."""
        radiance, depth = np.empty(shape, np.float32), np.empty(shape, np.float32)
        return cls(radiance, depth, np.empty((*shape, 3), np.float32), np.empty(shape, bool))

    def take_from(self, other: "Radiance", rows: slice, chosen: np.ndarray) -> None:
        """Copy chosen pixels, (rows, w) bool, of some rows of another rendering of the same size."""
        for name in ("radiance_factor", "depth_m", "normal", "sunlit"):
            getattr(self, name)[rows][chosen] = getattr(other, name)[rows][chosen]
