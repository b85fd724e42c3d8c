"""The engine `heightfield`: renders a scene by rays over its height field, with the same light as the stage in Blender.

Light, photometry, albedo, the Sun's disc and the pixel's box filter are those of `perilune_render.blender`. Deviations:
the samples' places in pixel and disc are drawn by NumPy; light that other ground scatters, and earthshine, are not
rendered.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from perilune_render.config import DatasetConfig
from perilune_render.heightfield.horizon import NOWHERE, Horizon, horizon_of
from perilune_render.heightfield.shade import see
from perilune_render.heightfield.surface import Surface, surface_of
from perilune_render.imaging.photometry import reflectance_factor
from perilune_render.imaging.radiance import Radiance
from perilune_render.streams import stream
from perilune_render.terrain.scene import Scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import plane_basis
from perilune_shared.geometry.frames import Array

_FAR_M = 100_000.0
"""Depth beyond which nothing is rendered, metres: that of the camera in Blender."""
_TILE_PX = 64
"""Width of the tiles of an image that are rendered one after another."""
_RAYS_AT_ONCE = 8192
"""Rays of a tile, if a row of it has no more: their photometry fits the cache of a core."""
_RAYS_PER_VERTEX = 0.3
"""Rays, in numbers of vertices, after which the horizon is made: without it they have taken as long as it takes."""


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
        self._disc_rad = np.float32(np.radians(config.light.sun_angular_diameter_deg) / 2)
        self.horizon, self._n_rays = NOWHERE, 0
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
        height, width, n = self.camera.height_px, self.camera.width_px, self._samples
        rng = stream(seed, "rays")
        moved = rng.random((n, height, width, 2), np.float32) - np.float32(0.5)
        moved[0] = 0.0
        drawn = rng.random((n, height, width, 2), np.float32)
        origin = np.asarray(position_m, np.float64) - [*self.surface.centre_m, 0.0]
        basis = _rays_of(self.camera) @ rotation_camera_from_site
        plane, horizon = np.stack(plane_basis(self.sun)), self._horizon_now()
        radiance, depth = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
        normal = np.empty((height, width, 3), np.float32)

        def cast(first: tuple[int, int]) -> None:
            tile = slice(first[0], first[0] + rows), slice(first[1], first[1] + _TILE_PX)
            places, disc = moved[:, *tile], self._disc(drawn[:, *tile])
            angles = np.empty((5, *places.shape[:3]), np.float32)
            ground, rocks = self.surface.ground, self.surface.rocks
            see(
                ground,
                rocks,
                horizon,
                origin,
                basis,
                self.sun,
                plane,
                _FAR_M,
                first,
                places,
                disc,
                depth,
                normal,
                angles,
            )
            mu0, mu, cos_phase, albedo, lit = angles
            radiance[tile] = (reflectance_factor(self._law, mu0, mu, cos_phase) * albedo * lit).mean(axis=0)

        rows = max(_RAYS_AT_ONCE // (_TILE_PX * n), 1)
        firsts = [(row, column) for row in range(0, height, rows) for column in range(0, width, _TILE_PX)]
        list(self._threads.map(cast, firsts))
        return Radiance(radiance, depth, normal, radiance > 1e-4)

    def _disc(self, drawn: np.ndarray) -> np.ndarray:
        """Uniform places (..., 2) on the Sun's disc at unit distance, for uniform random numbers (..., 2)."""
        radius, angle = self._disc_rad * np.sqrt(drawn[..., 0]), np.float32(2 * np.pi) * drawn[..., 1]
        length = np.tan(radius)
        return np.stack([length * np.cos(angle), length * np.sin(angle)], axis=-1)

    def _horizon_now(self) -> Horizon:
        """The horizon for a frame; `NOWHERE` as long as it costs less. Frames are the same with any horizon."""
        self._n_rays += self._samples * self.camera.width_px * self.camera.height_px
        if self.horizon is NOWHERE and self._n_rays > _RAYS_PER_VERTEX * len(self.surface.ground.vertex):
            self.horizon = horizon_of(self.surface.ground, self.sun, float(self._disc_rad))
        return self.horizon


def _rays_of(camera: Camera) -> Array:
    """Rows (3, 3): how a ray of a camera without distortion changes with u, with v, and the ray at u = v = 0."""
    start, right, down = camera.rays([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    return np.stack([right - start, down - start, start])
