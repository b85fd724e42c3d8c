"""Radiance: the rendering of one frame, from which the sensor model computes the image."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Radiance:
    """Rendering of one frame, before the sensor model."""

    radiance_factor: np.ndarray
    """Radiance factor I/F (h, w) float32."""
    depth_m: np.ndarray
    """Depth along the camera's axis of the point that the ray through the pixel's centre hits, metres, infinite without
    a hit (h, w) float32."""
    normal: np.ndarray
    """Unit shading normal in O_L, 0 without a hit (h, w, 3) float32. With dataset.render.exr it is the normal at the
    hit of the ray through the pixel's centre, otherwise the mean direction over the pixel's samples."""
    sunlit: np.ndarray
    """Whether the pixel is sunlit (h, w) bool."""
    blurred: np.ndarray | None = None
    """Mean radiance factor of several poses during the exposure (h, w) float32; None for a single pose. EXRs do not
    contain it."""

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> "Radiance":
        """A rendering (h, w) whose values are not set yet."""
        radiance, depth = np.empty(shape, np.float32), np.empty(shape, np.float32)
        return cls(radiance, depth, np.empty((*shape, 3), np.float32), np.empty(shape, bool))

    def take_from(self, other: "Radiance", rows: slice, chosen: np.ndarray) -> None:
        """Copy pixels of some rows from another rendering of the same size.

        `chosen` (n_rows, w) is true for the pixels to copy.
        """
        for name in ("radiance_factor", "depth_m", "normal", "sunlit"):
            getattr(self, name)[rows][chosen] = getattr(other, name)[rows][chosen]
