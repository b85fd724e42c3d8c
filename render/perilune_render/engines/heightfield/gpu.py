"""The engine `heightfield` on a CUDA device: the same kernels, for all pixels of many frames at once.

numba compiles the functions that cast and shade a ray (`shade.sample_seen`, `light.factor_of`) for the device as well,
so there is one source. Every thread renders one pixel. It draws its samples from NumPy's stream (`draws`), so they are
the samples of the processor. Sums and the functions of the C library are rounded differently, so frames are equal to
the processor's within 1e-4 outside the edges of shadows, and not to the byte.

    engine = CudaEngine(scene, config, camera, sun)
    frames = engine.render_batch(positions_m, rotations_camera_from_site, seeds)
    torch.from_dlpack(frames.radiance_factor)      # (N, h, w), without a copy

With the environment variable NUMBA_ENABLE_CUDASIM=1, numba simulates the device; this is for tests with tiny frames.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import config, cuda

from perilune_render.config.dataset import DatasetConfig
from perilune_render.engines.heightfield.dlpack import SharedArray
from perilune_render.engines.heightfield.draws import state_of, uniform_pair
from perilune_render.engines.heightfield.engine import LIT, HeightfieldEngine, rays_of
from perilune_render.engines.heightfield.horizon import Horizon
from perilune_render.engines.heightfield.light import LAW_NUMBERS, disc_place, factor_of, factors_of
from perilune_render.engines.heightfield.shade import Block, View, sample_seen
from perilune_render.engines.heightfield.surface import Surface
from perilune_render.flight.sub_poses import Pose
from perilune_render.imaging.radiance import Radiance
from perilune_render.provenance.versions import check_installed
from perilune_render.streams import stream
from perilune_render.terrain.scene import Scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import plane_basis
from perilune_shared.geometry.frames import Array

_BLOCK_PX = 8
"""Width and height of the pixels of a block of threads; neighbouring rays read the same memory."""
_MAX_FRAMES = 4096
"""Largest number of frames of one launch."""


class _Light(NamedTuple):
    """The Sun and the ground's reflectance."""

    sun: Any
    """`View.sun`."""
    plane: Any
    """`View.plane`."""
    far_m: float
    """`View.far_m`."""
    disc_rad: np.float32
    """Angular radius of the Sun's disc, radians."""
    law: int
    """Number of the law (`light.LAW_NUMBERS`)."""
    factors: Any
    """Constants of the law (`light.factors_of`)."""


class _Shots(NamedTuple):
    """N frames to render, on the device."""

    origin: Any
    """`View.origin` (N, 3)."""
    basis: Any
    """`View.basis` (N, 3, 3)."""
    state: Any
    """State of each frame's random stream (`draws.state_of`) (N, 4) uint64."""


class _Part(NamedTuple):
    """The part of the frames to render."""

    first_row: int
    """First row."""
    n_rows: int
    """Number of rows."""
    n_samples: int
    """Samples of each pixel."""


class _Images(NamedTuple):
    """Rendered frames on the device, as arguments of the kernel; see `FrameBatch`."""

    radiance_factor: Any
    depth_m: Any
    normal: Any
    sunlit: Any


@dataclass(frozen=True, slots=True)
class FrameBatch:
    """N rendered frames in the memory of the device. The arrays support DLPack and the CUDA array interface."""

    radiance_factor: SharedArray
    """Radiance factor I/F (N, h, w) float32."""
    depth_m: SharedArray
    """Depth along the camera's axis at each pixel's centre, metres, infinite without a hit (N, h, w) float32."""
    normal: SharedArray
    """Unit shading normal in O_L, 0 without a hit (N, h, w, 3) float32."""
    sunlit: SharedArray
    """Whether the pixel is sunlit (N, h, w) uint8."""

    def __len__(self) -> int:
        return self.radiance_factor.shape[0]

    def to_host(self) -> list[Radiance]:
        """Copies of the frames in the memory of the processor."""
        parts = (each.to_host() for each in (self.radiance_factor, self.depth_m, self.normal, self.sunlit))
        return [
            Radiance(factor, depth, normal, lit.astype(bool)) for factor, depth, normal, lit in zip(*parts, strict=True)
        ]


@cuda.jit
def _render(ground, rocks, horizon, light, shots, images, part):
    """Render one pixel of one frame in each thread: x and y of the grid are column and row, z is the frame."""
    column, row, frame = cuda.grid(3)
    frames, height, width = images.radiance_factor.shape
    if column >= width or row >= part.n_rows or frame >= frames:
        return
    row += part.first_row
    state, view = (
        shots.state[frame],
        View(shots.origin[frame], shots.basis[frame], light.far_m, light.sun, light.plane, horizon),
    )
    n_samples = part.n_samples
    block, total = Block(np.inf, -1), np.float32(0)
    for s in range(n_samples):
        # As `HeightfieldEngine._drawn`: the first half of the stream moves the samples, the second is for the disc.
        number = (s * height + row) * width + column
        u, v = column + 0.5, row + 0.5
        if s > 0:
            du, dv = uniform_pair(state, np.uint64(number))
            u, v = u + (du - np.float32(0.5)), v + (dv - np.float32(0.5))
        first, second = uniform_pair(state, np.uint64(n_samples * height * width + number))
        depths, normal, angles = sample_seen(
            ground, rocks, view, block, (u, v), disc_place(light.disc_rad, first, second)
        )
        mu0, mu, cos_phase = np.float32(angles[0]), np.float32(angles[1]), np.float32(angles[2])
        factor = factor_of(light.law, light.factors, mu0, mu, cos_phase)
        total += factor * np.float32(angles[3]) * np.float32(angles[4])
        if s == 0:
            images.depth_m[frame, row, column] = depths[1]
            for axis in range(3):
                images.normal[frame, row, column, axis] = normal[axis]
    mean = total / np.float32(n_samples)
    images.radiance_factor[frame, row, column] = mean
    images.sunlit[frame, row, column] = mean > LIT


class CudaEngine(HeightfieldEngine):
    """Renders frames of one scene on a CUDA device; an `Engine` of `perilune_render.engines.frame_source`.

    Raises UserError without a device, or if the ground and one frame do not fit into its free memory.
    """

    def __init__(self, scene: Scene, config: DatasetConfig, camera: Camera, sun: Array, surface: Surface | None = None):
        check_installed("heightfield", "cuda")
        if camera.lens is not None:
            expected = "cpu with the lens model of dataset.camera.lens"
            raise UserError("configuration", "dataset.render.device", "cuda", expected)
        super().__init__(scene, config, camera, sun, surface=surface)
        size = sum(part.nbytes for part in (*self.surface.ground, *self.surface.rocks) if isinstance(part, np.ndarray))
        self._check_memory(size + self.bytes_of(1))
        self._ground, self._rocks = _on_device(self.surface.ground), _on_device(self.surface.rocks)
        self._light = _Light(
            sent_to_device(self.sun),
            sent_to_device(np.stack(plane_basis(self.sun))),
            float(self._far_m),
            self._disc_rad,
            LAW_NUMBERS[self._law],
            factors_of(self._law),
        )
        self._horizon_sent: tuple[Horizon, Any] | None = None

    def bytes_of(self, n_frames: int) -> int:
        """Device memory of a batch, bytes."""
        return n_frames * self.camera.height_px * self.camera.width_px * (5 * 4 + 1)

    def render(
        self, position_m: Array, rotation_camera_from_site: Array, seed: int = 0, approach_deg: int = 0
    ) -> Radiance:
        """Render one frame, as `HeightfieldEngine.render`."""
        position, rotation = np.asarray(position_m)[None], np.asarray(rotation_camera_from_site)[None]
        return self.render_batch(position, rotation, [seed]).to_host()[0]

    def render_batch(self, positions_m: Array, rotations_camera_from_site: Array, seeds: Sequence[int]) -> FrameBatch:
        """Render a frame for each position (N, 3), O_L, metres, rotation matrix (N, 3, 3) and random seed.

        Returns before the device has finished. Raises UserError if the frames do not fit into the free memory.
        """
        positions, rotations = np.asarray(positions_m, np.float64), np.asarray(rotations_camera_from_site, np.float64)
        if positions.shape != (len(seeds), 3) or rotations.shape != (len(seeds), 3, 3) or not len(seeds):
            shapes = f"positions {positions.shape}, rotations {rotations.shape}, {len(seeds)} seeds"
            raise UserError("render_batch", "poses", shapes, "(N, 3), (N, 3, 3) and N seeds, N at least 1")
        self._check_memory(self.bytes_of(len(seeds)))
        images = self._empty(len(seeds))
        states = np.stack([state_of(stream(seed, "rays")) for seed in seeds])
        horizon = self._horizon_now(len(seeds) * self.camera.height_px * self.camera.width_px)
        for start in range(0, len(seeds), _MAX_FRAMES):
            some = slice(start, start + _MAX_FRAMES)
            parts = _Images(*(part[some] for part in images))
            self._launch(
                parts, positions[some], rotations[some], states[some], horizon, slice(0, self.camera.height_px)
            )
        return FrameBatch(*(SharedArray(part) for part in images))

    def _drawn(self, seed: int) -> Any:
        return state_of(stream(seed, "rays"))

    def _cast(
        self, image: Radiance, tiles: list[tuple[slice, slice]], pose: Pose, drawn: Any, horizon: Horizon
    ) -> None:
        """Render all rows that the tiles touch, and copy the tiles."""
        if not tiles:
            return
        rows = slice(min(tile[0].start for tile in tiles), min(max(tile[0].stop for tile in tiles), len(image.depth_m)))
        images = self._empty(1)
        self._launch(images, np.asarray(pose[0])[None], np.asarray(pose[1])[None], drawn[None], horizon, rows)
        (new,) = FrameBatch(*(SharedArray(part) for part in images)).to_host()
        for tile in tiles:
            for name in ("radiance_factor", "depth_m", "normal", "sunlit"):
                getattr(image, name)[tile] = getattr(new, name)[tile]

    def _empty(self, n_frames: int) -> _Images:
        shape = n_frames, self.camera.height_px, self.camera.width_px
        factor, depth = empty_on_device(shape, np.float32), empty_on_device(shape, np.float32)
        return _Images(factor, depth, empty_on_device((*shape, 3), np.float32), empty_on_device(shape, np.uint8))

    def _launch(
        self, images: _Images, positions: Array, rotations: Array, states: np.ndarray, horizon: Horizon, rows: slice
    ) -> None:
        origins = positions - [*self.surface.centre_m, 0.0]
        shots = _Shots(*map(sent_to_device, (origins, rays_of(self.camera) @ rotations, states)))
        if self._horizon_sent is None or self._horizon_sent[0] is not horizon:
            self._horizon_sent = horizon, _on_device(horizon)
        part = _Part(rows.start, rows.stop - rows.start, self._samples)
        blocks = math.ceil(self.camera.width_px / _BLOCK_PX), math.ceil(part.n_rows / _BLOCK_PX), len(positions)
        _render[blocks, (_BLOCK_PX, _BLOCK_PX, 1)](
            self._ground, self._rocks, self._horizon_sent[1], self._light, shots, images, part
        )

    def _check_memory(self, needed: int) -> None:
        """Raise UserError if the device has less free memory, bytes."""
        free = cuda.current_context().get_memory_info()[0]
        if needed > free:
            found, expected = f"cuda, with {free / 2**20:.0f} MiB free", f"{needed / 2**20:.0f} MiB, or cpu"
            raise UserError("configuration", "dataset.render.device", found, expected)


def device_name() -> str:
    """Name of the CUDA device; `simulator` in numba's simulator."""
    if config.ENABLE_CUDASIM:
        return "simulator"
    name = cuda.get_current_device().name
    return name.decode() if isinstance(name, bytes) else str(name)


def _on_device(arrays: Any) -> Any:
    """The named tuple with its arrays in the memory of the device."""
    return type(arrays)(*(sent_to_device(part) if isinstance(part, np.ndarray) else part for part in arrays))


def sent_to_device(array: np.ndarray) -> Any:
    """The array in the memory of the device. The simulator's arrays are NumPy's, which compiled functions accept."""
    return array if config.ENABLE_CUDASIM else cuda.to_device(array)


def empty_on_device(shape: int | tuple[int, ...], dtype: Any) -> Any:
    """An array in the memory of the device, without values."""
    return np.empty(shape, dtype) if config.ENABLE_CUDASIM else cuda.device_array(shape, dtype)
