"""A second rendering engine in NumPy: flat terrain with a reflectance law, without shadows."""

import numpy as np

from perilune_render.imaging.radiance import Radiance
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_shared.photometry import radiance_factor


class FlatEngine:
    """Renders the plane z = 0 of O_L; an engine for `perilune_render.engines.frame_source`."""

    def __init__(self, law: str, camera: Camera, sun: Array):
        self.law, self.camera, self.sun = law, camera, sun

    def render(self, position_m: Array, rotation_camera_from_site: Array, seed: int, approach_deg: int = 0) -> Radiance:
        """Render with one ray through each pixel centre; the seed and the approach have no effect."""
        rays = self.camera.rays(self.camera.pixel_centres()) @ rotation_camera_from_site
        depth_m = (-position_m[2] / rays[..., 2]).astype(np.float32)
        view = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        factor = radiance_factor(self.law, self.sun[2], view[..., 2], view @ self.sun)
        normal = np.broadcast_to(np.float32([0, 0, 1]), rays.shape)
        return Radiance(factor.astype(np.float32), depth_m, normal, np.ones(depth_m.shape, bool))
