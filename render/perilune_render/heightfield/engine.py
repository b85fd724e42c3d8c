"""The engine `heightfield`: renders a scene by rays over its height field, with the same light as the stage in Blender.

Light, photometry, albedo, the Sun's disc and the pixel's box filter are those of `perilune_render.blender`. Deviations:
the samples' places in pixel and disc are drawn by NumPy; light that other ground scatters, and earthshine, are not
rendered.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from perilune_render.config import DatasetConfig
from perilune_render.heightfield.shade import see
from perilune_render.heightfield.surface import Surface, surface_of
from perilune_render.imaging.photometry import reflectance_factor
from perilune_render.imaging.radiance import Radiance
from perilune_render.streams import stream
from perilune_render.sub_poses import Pose, RowPoses
from perilune_render.terrain.scene import Scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import plane_basis
from perilune_shared.geometry.frames import Array

_RAYS_AT_ONCE = 8192


class HeightfieldEngine:
    """Renders frames of one scene. It is an `Engine` of `perilune_render.frame_source`; several may be open.

    Raises UserError if the configuration asks for light that this engine does not render.
    """

    def __init__(
        self,
        scene: Scene,
        config: DatasetConfig,
        camera: Camera,
        sun: Array,
        n_threads: int = 1,
        surface: Surface | None = None,
    ):
        for name in ("bounce", "earthshine"):
            if getattr(config.light, name):
                raise UserError(
                    "configuration", f"dataset.light.{name}", True, "false, or dataset.render.engine cycles"
                )
        self.camera, self.sun = camera, np.asarray(sun, np.float64)
        self.surface = surface if surface is not None else surface_of(scene)
        self._law, self._samples = config.light.photometry, config.render.samples
        self._disc_rad = np.radians(config.light.sun_angular_diameter_deg) / 2
        self._far_m = scene.grid.farthest_m
        self._centres = camera.pixel_centres().reshape(-1, 2)
        self._threads = ThreadPoolExecutor(n_threads, "rays")

    def close(self) -> None:
        """End the threads."""
        self._threads.shutdown()

    def __enter__(self) -> "HeightfieldEngine":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def render(
        self, position_m: Array, rotation_camera_from_site: Array, seed: int = 0, approach_deg: int = 0
    ) -> Radiance:
        """Render one frame: radiance factor averaged over each pixel; depth and normal of the ray through its centre.

        The first sample of a pixel is at its centre. `approach_deg` is not used: the ground is one mesh.
        """
        everything = slice(0, len(self._centres))
        return self._render([(everything, (position_m, rotation_camera_from_site))], seed)

    def render_rows(self, poses: RowPoses, seed: int = 0, approach_deg: int = 0) -> Radiance:
        """Render one frame with a pose for each row of the sensor; a depth is along the axis at its row's pose."""
        bands = poses.bands(len(poses.time_s))
        return self._render([(np.flatnonzero(pixels), pose) for pixels, pose in bands if pixels.any()], seed)

    def _render(self, bands: list[tuple[slice | np.ndarray, Pose]], seed: int) -> Radiance:
        """Render one frame of which each band of pixels, by their indices, has its own pose."""
        n_pixels = len(self._centres)
        rng = stream(seed, "rays")
        moved = rng.random((self._samples, n_pixels, 2), np.float32) - np.float32(0.5)
        moved[0] = 0.0
        disc = rng.random((self._samples, n_pixels, 2), np.float32)
        parts = [
            (sample, pixels[first : first + _RAYS_AT_ONCE], pose)
            for sample in range(self._samples)
            for pixels, pose in ((np.arange(n_pixels)[band], pose) for band, pose in bands)
            for first in range(0, len(pixels), _RAYS_AT_ONCE)
        ]
        radiance = np.zeros((self._samples, n_pixels), np.float32)
        depth, normal = np.empty(n_pixels, np.float32), np.empty((n_pixels, 3), np.float32)

        def cast(part: tuple[int, np.ndarray, Pose]) -> None:
            sample, pixels, (position_m, rotation_camera_from_site) = part
            origin = np.asarray(position_m, np.float64) - [*self.surface.centre_m, 0.0]
            rays = self.camera.rays(self._centres[pixels] + moved[sample, pixels]) @ rotation_camera_from_site
            own_depth, own_normal, seen = self._see(origin, np.ascontiguousarray(rays), disc[sample, pixels])
            radiance[sample, pixels] = seen
            if sample == 0:
                depth[pixels], normal[pixels] = own_depth, own_normal

        list(self._threads.map(cast, parts))
        shape = self.camera.height_px, self.camera.width_px
        mean = radiance.mean(axis=0)
        return Radiance(
            mean.reshape(shape), depth.reshape(shape), normal.reshape(*shape, 3), (mean > 1e-4).reshape(shape)
        )

    def _see(self, origin: Array, rays: Array, disc: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth (N,), normal (N, 3) and radiance factor (N,) of rays (N, 3) with z = 1 along the camera's axis."""
        n = len(rays)
        across, along = plane_basis(self.sun)
        radius, angle = self._disc_rad * np.sqrt(disc[:, :1]), 2 * np.pi * disc[:, 1:]
        suns = self.sun + np.tan(radius) * (np.cos(angle) * across + np.sin(angle) * along)
        suns /= np.linalg.norm(suns, axis=1, keepdims=True)
        depth, normal = np.empty(n), np.empty((n, 3))
        angles, lit = np.empty((n, 4)), np.empty(n)
        ground, rocks = self.surface.ground, self.surface.rocks
        see(ground, rocks, origin, rays, suns, self.sun, self._far_m, depth, normal, angles, lit)
        mu0, mu, cos_phase, albedo = angles.astype(np.float32).T
        seen = reflectance_factor(self._law, mu0, mu, cos_phase) * albedo * lit.astype(np.float32)
        return depth, normal, seen
