"""The engine `heightfield`: casts rays at the height field of a scene, lit as in Blender.

Light, photometry, albedo, the Sun's disc and the pixel's box filter match `perilune_render.engines.blender`.
Deviations: the sample points in the pixel and on the disc are drawn by NumPy; earthshine and light scattered by other
ground are not rendered.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.engines.heightfield.beam import tops_of
from perilune_render.engines.heightfield.horizon import NOWHERE, Horizon, horizon_of
from perilune_render.engines.heightfield.light import disc_places, reflected
from perilune_render.engines.heightfield.shade import Tile, View, see, see_along
from perilune_render.engines.heightfield.surface import Surface, surface_of
from perilune_render.flight.sub_poses import Pose, RowPoses
from perilune_render.imaging.radiance import Radiance
from perilune_render.streams import stream
from perilune_render.terrain.scene import Scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import plane_basis
from perilune_shared.geometry.frames import Array

_TILE_PX = 64
"""Width of the tiles in which an image is rendered, pixels."""
_RAYS_AT_ONCE = 8192
"""Largest number of rays in a tile of several rows. The photometry of this many rays fits into the cache of a core."""
_SMALL_TILE_PX = 16
"""Width and height of the tiles in which parts of an image are rendered again, pixels."""
LIT = 1e-4
"""Radiance factor above which a pixel counts as sunlit."""
_RAYS_PER_VERTEX = 0.3
"""Rays per ground vertex after which the horizon is computed. For fewer rays, this would take longer than it saves."""


class HeightfieldEngine:
    """Renders frames of one scene by casting rays; an `Engine` of `perilune_render.engines.frame_source`.

    Several of these engines may be open. Raises UserError if the configuration has bounce or earthshine.
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
        self.tops = tops_of(self.surface.ground)
        self._law, self._samples = config.light.photometry, config.render.samples
        self._disc_rad = np.float32(np.radians(config.light.sun_angular_diameter_deg) / 2)
        self._far_m = scene.grid.farthest_m
        self.horizon, self._n_rays = NOWHERE, 0
        # With one thread, the caller renders: passing tiles to another thread would cost more than it gains.
        self._threads = ThreadPoolExecutor(n_threads, "rays") if n_threads > 1 else None

    def close(self) -> None:
        """End the threads, if there are any."""
        if self._threads is not None:
            self._threads.shutdown()

    def __enter__(self) -> "HeightfieldEngine":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def render(
        self, position_m: Array, rotation_camera_from_site: Array, seed: int = 0, approach_deg: int = 0
    ) -> Radiance:
        """Render one frame: mean radiance factor of each pixel, depth and normal of its central ray.

        The depth is measured along the camera's axis, or along the ray for a camera with a lens model.
        `approach_deg` is not used, since the ground is one mesh.
        """
        shape = self.camera.height_px, self.camera.width_px
        image = Radiance.empty(shape)
        pose = position_m, rotation_camera_from_site
        self._cast(image, self._tiles(slice(0, shape[0])), pose, self._drawn(seed), self._horizon_now())
        return image

    def render_again(
        self, before: Radiance, wanted: np.ndarray, position_m: Array, rotation_camera_from_site: Array, seed: int = 0
    ) -> Radiance:
        """The radiance factors and depths of a rendering, with new pixels where `wanted` (h, w) is true.

        Some pixels around them are new too. The new pixels equal the pixels of `render` with the same pose and seed.
        """
        height, width = before.radiance_factor.shape
        image = Radiance.empty((height, width))
        image.radiance_factor[:], image.depth_m[:] = before.radiance_factor, before.depth_m
        pose, size = (position_m, rotation_camera_from_site), _SMALL_TILE_PX
        places = np.unique(np.argwhere(wanted) // size, axis=0) * size
        tiles = [(slice(row, row + size), slice(column, column + size)) for row, column in places.tolist()]
        self._cast(image, tiles, pose, self._drawn(seed), self._horizon_now(len(tiles) * size**2))
        return image

    def render_rows(self, poses: RowPoses, seed: int = 0, approach_deg: int = 0) -> Radiance:
        """Render one frame with a pose for each row of the sensor.

        The depth of a pixel is along the camera's axis at the pose of its row.
        """
        shape = self.camera.height_px, self.camera.width_px
        whole, band = Radiance.empty(shape), Radiance.empty(shape)
        drawn, horizon = self._drawn(seed), self._horizon_now()
        for pixels, pose in poses.bands(len(poses.time_s)):
            seen = np.flatnonzero(pixels.any(axis=1))
            if not len(seen):
                continue
            # A row of a sensor with distortion crosses several rows of the rendering.
            rows = slice(int(seen[0]), int(seen[-1]) + 1)
            self._cast(band, self._tiles(rows), pose, drawn, horizon)
            whole.take_from(band, rows, pixels[rows])
        return whole

    def _drawn(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Offsets of the samples from the pixel centres, and uniform numbers for the Sun's disc.

        Both are (samples, h, w, 2) float32. The first sample of a pixel is at its centre.
        """
        rng, shape = stream(seed, "rays"), (self._samples, self.camera.height_px, self.camera.width_px, 2)
        moved = rng.random(shape, np.float32) - np.float32(0.5)
        moved[0] = 0.0
        return moved, rng.random(shape, np.float32)

    def _tiles(self, rows: slice) -> list[tuple[slice, slice]]:
        """The tiles, rows and columns, in which some rows of an image are rendered."""
        tile_rows = max(_RAYS_AT_ONCE // (_TILE_PX * self._samples), 1)
        return [
            (slice(row, min(row + tile_rows, rows.stop)), slice(column, column + _TILE_PX))
            for row in range(rows.start, rows.stop, tile_rows)
            for column in range(0, self.camera.width_px, _TILE_PX)
        ]

    def _cast(
        self,
        image: Radiance,
        tiles: list[tuple[slice, slice]],
        pose: Pose,
        drawn: tuple[np.ndarray, np.ndarray],
        horizon: Horizon,
    ) -> None:
        """Render tiles from one pose into `image`, on all threads."""
        position_m, rotation_camera_from_site = pose
        moved, disc = drawn
        origin = np.asarray(position_m, np.float64) - [*self.surface.centre_m, 0.0]
        plane = np.stack(plane_basis(self.sun))
        curved = self.camera.lens is not None
        basis = np.zeros((3, 3)) if curved else rays_of(self.camera) @ rotation_camera_from_site
        view = View(origin, basis, self._far_m, self.sun, plane, horizon)
        ground, rocks = self.surface.ground, self.surface.rocks

        def cast(tile: tuple[slice, slice]) -> None:
            moves, suns = moved[:, *tile], disc_places(disc[:, *tile], self._disc_rad)
            angles = np.empty((5, *moves.shape[:3]), np.float32)
            first = tile[0].start, tile[1].start
            results = Tile(first, moves, suns, image.depth_m, image.normal, angles)
            if curved:
                starts, rays = self._rays(moves, first, origin, rotation_camera_from_site)
                own = view._replace(origin=origin.copy(), basis=basis.copy())
                see_along(ground, rocks, own, results, starts, rays)
            else:
                see(ground, rocks, self.tops, view, results)
            seen = reflected(self._law, angles).mean(axis=0)
            image.radiance_factor[tile], image.sunlit[tile] = seen, seen > LIT

        if self._threads is not None:
            list(self._threads.map(cast, tiles))
            return
        for each in tiles:
            cast(each)

    def _rays(
        self, moved: np.ndarray, first: tuple[int, int], origin: Array, rotation_camera_from_site: Array
    ) -> tuple[Array, Array]:
        """Starts, relative to the grid's centre, metres, and directions, O_L, of a tile's rays (S, h, w, 3) each."""
        _, height, width, _ = moved.shape
        row, column = np.ogrid[first[0] : first[0] + height, first[1] : first[1] + width]
        pixels = moved.astype(np.float64)
        pixels += np.stack(np.broadcast_arrays(column + 0.5, row + 0.5), axis=-1)
        rays, starts = self.camera.rays_and_starts(pixels)
        return origin + starts @ rotation_camera_from_site, rays @ rotation_camera_from_site

    def _horizon_now(self, n_pixels: int | None = None) -> Horizon:
        """The horizon, or `NOWHERE` while computing it would not save time; `n_pixels` None means a whole image.

        Frames do not depend on the horizon.
        """
        self._n_rays += self._samples * (n_pixels or self.camera.width_px * self.camera.height_px)
        if self.horizon is NOWHERE and self._n_rays > _RAYS_PER_VERTEX * len(self.surface.ground.vertex):
            self.horizon = horizon_of(self.surface.ground, self.sun, float(self._disc_rad))
        return self.horizon


def rays_of(camera: Camera) -> Array:
    """Basis (3, 3) of the rays of a camera without distortion.

    The rows are the change of the ray per pixel of u, the change per pixel of v, and the ray at u = v = 0.
    """
    start, right, down = camera.rays([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    return np.stack([right - start, down - start, start])
