"""Sensor and labels on a CUDA device: a batch of frames that stays in its memory.

The steps are those of `imaging.sensor` and `labels.frame_labels`, and the loops over the pixels of a crater are the
same functions. Two steps differ from the processor. Noise is drawn by a counter-based generator (`draws.philox`), so a
frame does not depend on its batch; its distribution is the same. Motion blur reads the image at exact positions, which
OpenCV rounds to 1/32 px.

    source = CudaSource(frame_source)                # a FrameSource whose engine is a CudaEngine
    batch = source.take(shots)
    torch.from_dlpack(batch.images)                  # (N, h, w), without a copy
    labels = source.labels(batch)
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import cuda

from perilune_render.config.dataset import SensorConfig
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.engines.heightfield.dlpack import SharedArray
from perilune_render.engines.heightfield.draws import normal_and_uniform, poisson
from perilune_render.engines.heightfield.gpu import CudaEngine, FrameBatch, empty_on_device, sent_to_device
from perilune_render.imaging.sensor import (
    FAINT_E,
    HOT_PIXEL_S,
    MIN_MOTION_PX,
    blur_nodes,
    exposure_time_of,
    psf_kernel,
)
from perilune_render.labels.frame_labels import Labels, centred_labels, image_from_rim, rims_of
from perilune_render.labels.pixels import N_FITTED, floored, lit_share, pinhole_of, rim_share, shading
from perilune_render.streams import stream
from perilune_shared.geometry.ellipse import Ellipses
from perilune_shared.geometry.frames import Array

_SIDE = 8
"""Width and height of the pixels of a block of threads."""
_THREADS = 128
"""Threads that together read all pixels of one frame, or each label a crater."""
_DIGIT_BITS, _DIGITS = 8, 256
"""Bits of a digit in the search for a percentile, and the number of digits."""


class _Sensor(NamedTuple):
    """Constants of the sensor, as an argument of kernels; see `SensorConfig`."""

    responsivity_e_per_s: float
    dark_e_per_s: float
    read_noise_e: float
    response_share: float
    """`gain_nonuniformity`."""
    offset_e: float
    """`dark_nonuniformity_e`."""
    full_well_e: float
    dn_per_e: float
    black_dn: float
    largest_dn: float


class _Lens(NamedTuple):
    """A camera without distortion, as an argument of kernels; all values in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


class _Labelled(NamedTuple):
    """The M labels of all frames of a batch, as an argument of a kernel."""

    frame: Any
    """Frame of each label (M,)."""
    rims: Any
    """Rims (`labels.pixels.Rims`)."""
    shapes: Any
    """Ellipses: cx, cy, a, b, theta, each (M,)."""
    boxes: Any
    """Bounding boxes of the ellipses (M, 4)."""
    centre: Any
    """Centres of the ellipses (M, 2)."""
    matrices: Any
    """`frame_labels.image_from_rim` (M, 2, 2)."""


class _Seen(NamedTuple):
    """What the labels of a batch are measured in, as an argument of a kernel."""

    position: Any
    """Positions of the camera (N, 3)."""
    rotation: Any
    """Rotation matrices (N, 3, 3)."""
    depth: Any
    sunlit: Any
    mean: Any
    """Mean of each grey value (N, h, w)."""
    deviation: Any
    """Standard deviation of each grey value (N, h, w)."""


@dataclass(frozen=True, slots=True)
class DeviceFrames:
    """N frames in the memory of the device."""

    shots: Sequence[Shot]
    """Poses, velocities and random seeds."""
    rendering: FrameBatch
    """Radiance, depth, normals and sunlit mask."""
    light: Any
    """Radiance factor of each pixel after point spread and motion blur (N, h, w) float32."""
    time_s: Array
    """Exposure times, seconds (N,), in the memory of the processor."""
    images: SharedArray
    """Grey values, DN (N, h, w): uint8, or uint16 above 8 bits."""

    def __len__(self) -> int:
        return len(self.shots)


@cuda.jit
def _spread(images, weights, axis, result):
    """Sum of the neighbours along an axis (1: rows, 2: columns), weighted; the image is mirrored at its edges."""
    column, row, frame = cuda.grid(3)
    frames, height, width = images.shape
    if column >= width or row >= height or frame >= frames:
        return
    half, total = len(weights) // 2, np.float32(0)
    size = height if axis == 1 else width
    for k in range(len(weights)):
        place = (row if axis == 1 else column) + k - half
        while place < 0 or place >= size:
            place = -place - 1 if place < 0 else 2 * size - 1 - place
        value = images[frame, place, column] if axis == 1 else images[frame, row, place]
        total += weights[k] * value
    result[frame, row, column] = total


@cuda.jit
def _percentile(keys, depth, share, places, found):
    """Find the two values of each frame around a percentile; all threads of a block read one frame.

    `keys` are the bits of positive float32 numbers, which have the order of the numbers. The largest key is found digit
    by digit. Pixels of the sky do not count, unless all pixels are sky. `found` (N, 2) receives the keys, `places` (N,)
    the position between them.
    """
    counts = cuda.shared.array(_DIGITS, np.int32)
    # Rank within the keys that have the prefix; prefix; next key.
    known = cuda.shared.array(3, np.uint64)
    frame, thread = cuda.blockIdx.x, cuda.threadIdx.x
    _, height, width = keys.shape
    pixels = height * width
    if thread == 0:
        counts[0] = 0
    cuda.syncthreads()
    hits = 0
    for pixel in range(thread, pixels, cuda.blockDim.x):
        if math.isfinite(depth[frame, pixel // width, pixel % width]):
            hits += 1
    cuda.atomic.add(counts, 0, hits)
    cuda.syncthreads()
    every = counts[0] == 0
    used = pixels if every else counts[0]
    cuda.syncthreads()
    if thread == 0:
        position = share * (used - 1)
        known[0], known[1], known[2] = np.uint64(floored(position)), np.uint64(0), np.uint64(2**32 - 1)
        places[frame] = position - floored(position)
    for digit in range(3, -1, -1):
        shift = np.uint64(_DIGIT_BITS * digit)
        for k in range(thread, _DIGITS, cuda.blockDim.x):
            counts[k] = 0
        cuda.syncthreads()
        for pixel in range(thread, pixels, cuda.blockDim.x):
            key = np.uint64(keys[frame, pixel // width, pixel % width])
            ground = every or math.isfinite(depth[frame, pixel // width, pixel % width])
            if ground and (key >> shift) >> np.uint64(_DIGIT_BITS) == known[1]:
                cuda.atomic.add(counts, int((key >> shift) & np.uint64(_DIGITS - 1)), 1)
        cuda.syncthreads()
        if thread == 0:
            rank, k = int(known[0]), 0
            while rank >= counts[k]:
                rank -= counts[k]
                k += 1
            known[0], known[1] = np.uint64(rank), (known[1] << np.uint64(_DIGIT_BITS)) + np.uint64(k)
            if digit == 0 and rank + 1 < counts[k]:
                known[2] = known[1]
        cuda.syncthreads()
    lower = known[1]
    if known[2] != lower:
        for pixel in range(thread, pixels, cuda.blockDim.x):
            key = np.uint64(keys[frame, pixel // width, pixel % width])
            if key > lower and (every or math.isfinite(depth[frame, pixel // width, pixel % width])):
                cuda.atomic.min(known, 2, key)
        cuda.syncthreads()
    if thread == 0:
        found[frame, 0] = np.uint32(lower)
        # At the largest value there is no next one, and its weight is 0.
        found[frame, 1] = np.uint32(known[2] if known[2] < np.uint64(2**32 - 1) else lower)


@cuda.jit
def _motion(depth, lens, move, turn, motion):
    """Motion of each pixel during the exposure, pixels, as `imaging.sensor.motion_px`."""
    column, row, frame = cuda.grid(3)
    frames, height, width = depth.shape
    if column >= width or row >= height or frame >= frames:
        return
    x, y = (column + 0.5 - lens.cx) / lens.fx, (row + 0.5 - lens.cy) / lens.fy
    z = depth[frame, row, column]
    a, b, c = turn[frame, 0], turn[frame, 1], turn[frame, 2]
    along = a * y - b * x
    u = (x * move[frame, 2] - move[frame, 0]) / z + x * along - b + c * y
    v = (y * move[frame, 2] - move[frame, 1]) / z + y * along + a - c * x
    motion[frame, row, column, 0] = u * lens.fx
    motion[frame, row, column, 1] = v * lens.fy


@cuda.jit
def _longest(motion, longest):
    """Largest squared motion of each frame (N,), pixels squared."""
    frame, thread = cuda.blockIdx.x, cuda.threadIdx.x
    _, height, width, _ = motion.shape
    largest = np.float32(0)
    for pixel in range(thread, height * width, cuda.blockDim.x):
        u, v = motion[frame, pixel // width, pixel % width, 0], motion[frame, pixel // width, pixel % width, 1]
        largest = max(largest, np.float32(u * u + v * v))
    cuda.atomic.max(longest, frame, largest)


@cuda.jit
def _blur(light, motion, times, weights, counts, result):
    """Mean of each image over the exposure, as `imaging.sensor.expose`; a frame without nodes is copied."""
    column, row, frame = cuda.grid(3)
    frames, height, width = light.shape
    if column >= width or row >= height or frame >= frames:
        return
    if counts[frame] == 0:
        result[frame, row, column] = light[frame, row, column]
        return
    total = 0.0
    for node in range(counts[frame]):
        x = column - times[frame, node] * motion[frame, row, column, 0]
        y = row - times[frame, node] * motion[frame, row, column, 1]
        left, top = floored(x), floored(y)
        value, norm = 0.0, 0.0
        for j in range(-3, 5):
            weight_y = _lanczos(y - top - j)
            for i in range(-3, 5):
                weight = weight_y * _lanczos(x - left - i)
                norm += weight
                place = min(max(top + j, 0), height - 1), min(max(left + i, 0), width - 1)
                value += weight * light[frame, place[0], place[1]]
        total += weights[frame, node] * value / norm
    result[frame, row, column] = max(total, 0.0)


@cuda.jit(device=True)
def _lanczos(distance):
    """Lanczos' kernel of half width 4 at a distance in pixels."""
    if abs(distance) < 1e-6:
        return 1.0
    angle = math.pi * distance
    return 4.0 * math.sin(angle) * math.sin(angle / 4.0) / (angle * angle)


@cuda.jit
def _read_out(light, time_s, keys, sensor, pattern, images):
    """Grey value of each pixel with its noise, as `imaging.sensor.read_out`."""
    column, row, frame = cuda.grid(3)
    frames, height, width = light.shape
    if column >= width or row >= height or frame >= frames:
        return
    response, offset, hot = pattern
    time = time_s[frame]
    electrons = light[frame, row, column] * response[row, column] * sensor.responsivity_e_per_s * time
    electrons += sensor.dark_e_per_s * time + hot[row, column] * (time / HOT_PIXEL_S)
    normal, uniform = normal_and_uniform(keys[frame, 0], keys[frame, 1], np.uint64(row * width + column))
    if electrons < FAINT_E:
        noisy = poisson(electrons, uniform) + sensor.read_noise_e * normal
    else:
        noisy = electrons + math.sqrt(electrons + sensor.read_noise_e**2) * normal
    grey = min(noisy + offset[row, column], sensor.full_well_e) * sensor.dn_per_e + sensor.black_dn
    images[frame, row, column] = int(min(max(grey + 0.5, 0.0), sensor.largest_dn))


@cuda.jit
def _expected(light, time_s, sensor, mean, deviation):
    """Mean and standard deviation of each grey value, as `imaging.sensor.expected`."""
    column, row, frame = cuda.grid(3)
    frames, height, width = light.shape
    if column >= width or row >= height or frame >= frames:
        return
    light_e = light[frame, row, column] * sensor.responsivity_e_per_s * time_s[frame]
    dark_e = sensor.dark_e_per_s * time_s[frame]
    grey = min(light_e + dark_e, sensor.full_well_e) * sensor.dn_per_e + sensor.black_dn
    variance_e2 = (
        light_e + (sensor.response_share * light_e) ** 2 + sensor.read_noise_e**2 + sensor.offset_e**2 + dark_e
    )
    mean[frame, row, column] = min(max(grey, 0.0), sensor.largest_dn)
    deviation[frame, row, column] = math.sqrt(sensor.dn_per_e**2 * variance_e2 + 1.0 / 12.0)


@cuda.jit
def _measure(labelled, seen, pinhole, shares):
    """Visible share, sunlit share and contrast of each label, one in each thread; `shares` is (M, 3)."""
    k = cuda.grid(1)
    if k >= len(labelled.frame):
        return
    frame = labelled.frame[k]
    scratch = (
        cuda.local.array(N_FITTED, np.float64),
        cuda.local.array(N_FITTED, np.float64),
        cuda.local.array((N_FITTED, N_FITTED), np.float64),
    )
    pose = seen.position[frame], seen.rotation[frame]
    shares[k, 0] = rim_share(labelled.rims, k, pose[0], pose[1], pinhole, seen.depth[frame])
    shares[k, 1] = lit_share(labelled.shapes, labelled.boxes, k, seen.sunlit[frame])
    shares[k, 2] = shading(labelled.centre, labelled.matrices, k, seen.mean[frame], seen.deviation[frame], scratch)


class CudaSource:
    """Renders, develops and labels batches of frames on a CUDA device."""

    def __init__(self, source: FrameSource):
        """`source` renders with a `CudaEngine`; see `CudaSource.fits`."""
        self._source, self._engine = source, source.engine
        sensor, pattern, camera = source.sensor, source.pattern, source.camera
        self._lens = _Lens(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
        self._pattern = tuple(map(sent_to_device, (pattern.response, pattern.offset_e, pattern.hot_e)))
        self._sensor = _constants(sensor)
        self._psf = sent_to_device(psf_kernel(sensor.psf_sigma_px).astype(np.float32)) if sensor.psf_sigma_px else None

    @staticmethod
    def fits(source: FrameSource) -> bool:
        """Whether the frames of a source can be made on the device.

        The engine must be a `CudaEngine`. Distortion, a rolling shutter and motion blur by several poses need the
        processor.
        """
        sensor = source.sensor
        plain = source.camera == source.engine.camera and sensor.blur_poses == 1 and not sensor.row_time_s
        return plain and isinstance(source.engine, CudaEngine)

    def take(self, shots: Sequence[Shot]) -> DeviceFrames:
        """Render and develop one frame for each shot. Raises UserError if they do not fit into the device's memory."""
        assert isinstance(self._engine, CudaEngine)
        positions = np.stack([shot.position_m for shot in shots])
        rotations = np.stack([shot.rotation_camera_from_site for shot in shots])
        rendering = self._engine.render_batch(positions, rotations, [shot.render_seed for shot in shots])
        light = self._spread(rendering.radiance_factor.array)
        time_s = self._times(light, rendering.depth_m.array)
        if self._source.sensor.motion_blur and any(shot.moves for shot in shots):
            light = self._blurred(light, rendering.depth_m.array, shots, time_s)
        keys = np.stack([_noise_key(shot) for shot in shots])
        images = empty_on_device(light.shape, np.uint8 if self._source.sensor.bits == 8 else np.uint16)
        _read_out[self._grid(light)](
            light, sent_to_device(time_s), sent_to_device(keys), self._sensor, self._pattern, images
        )
        return DeviceFrames(shots, rendering, light, time_s, SharedArray(images))

    def labels(self, frames: DeviceFrames) -> list[Labels]:
        """Labels of each frame. Ellipses are computed on the processor, everything that reads pixels on the device."""
        source, light = self._source, frames.light
        limits = source.bounds.bounds_px(source.camera.width_px)
        plain = [centred_labels(source.circles, source.camera, *shot.pose, limits) for shot in frames.shots]
        counts = [len(each.crater_id) for each in plain]
        if not sum(counts):
            return plain
        mean, deviation = (empty_on_device(light.shape, np.float32) for _ in range(2))
        _expected[self._grid(light)](light, sent_to_device(frames.time_s), self._sensor, mean, deviation)
        labelled = self._labelled(frames.shots, plain, counts)
        shares = empty_on_device((sum(counts), 3), np.float64)
        positions, rotations = (np.stack(part) for part in zip(*(shot.pose for shot in frames.shots), strict=True))
        seen = _Seen(
            sent_to_device(np.asarray(positions, np.float64)),
            sent_to_device(np.asarray(rotations, np.float64)),
            frames.rendering.depth_m.array,
            frames.rendering.sunlit.array,
            mean,
            deviation,
        )
        blocks = math.ceil(sum(counts) / _THREADS)
        _measure[blocks, _THREADS](labelled, seen, pinhole_of(source.camera), shares)
        parts = np.split(SharedArray(shares).to_host(), np.cumsum(counts)[:-1])
        return [
            replace(each, visible_fraction=part[:, 0], sunlit_fraction=part[:, 1], contrast=part[:, 2])
            for each, part in zip(plain, parts, strict=True)
        ]

    def _labelled(self, shots: Sequence[Shot], labels: Sequence[Labels], counts: Sequence[int]) -> _Labelled:
        circles, camera = self._source.circles, self._source.camera
        rows = [np.searchsorted(circles.crater_id, each.crater_id) for each in labels]
        ellipses = Ellipses(
            *(
                np.concatenate([getattr(each.ellipses, field.name) for each in labels])
                for field in dataclasses.fields(Ellipses)
            )
        )
        matrices = [
            image_from_rim(circles, camera, *shot.pose, self._engine.sun, some)
            for shot, some in zip(shots, rows, strict=True)
        ]
        shapes = ellipses.cx_px, ellipses.cy_px, ellipses.a_px, ellipses.b_px, ellipses.theta_rad
        rims = rims_of(circles, np.concatenate(rows))
        return _Labelled(
            sent_to_device(np.repeat(np.arange(len(shots)), counts)),
            type(rims)(*map(sent_to_device, rims)),
            tuple(sent_to_device(np.ascontiguousarray(part, np.float64)) for part in shapes),
            sent_to_device(ellipses.bounding_boxes()),
            sent_to_device(np.stack(shapes[:2], axis=-1)),
            sent_to_device(np.concatenate(matrices)),
        )

    def _spread(self, factor: Any) -> Any:
        """The images after the point spread."""
        if self._psf is None:
            return factor
        first, second = empty_on_device(factor.shape, np.float32), empty_on_device(factor.shape, np.float32)
        _spread[self._grid(factor)](factor, self._psf, 2, first)
        _spread[self._grid(factor)](first, self._psf, 1, second)
        return second

    def _times(self, light: Any, depth: Any) -> Array:
        """Exposure times, seconds (N,)."""
        sensor, count = self._source.sensor, len(light)
        if sensor.exposure == "fixed":
            return np.full(count, sensor.exposure_time_s)
        found, places = empty_on_device((count, 2), np.uint32), empty_on_device(count, np.float64)
        _percentile[count, _THREADS](light.view(np.uint32), depth, sensor.exposure_percentile / 100, places, found)
        around = SharedArray(found).to_host().view(np.float32).astype(np.float64)
        between = SharedArray(places).to_host()
        bright = around[:, 0] + between * (around[:, 1] - around[:, 0])
        return np.array([exposure_time_of(float(each), sensor) for each in bright])

    def _blurred(self, light: Any, depth: Any, shots: Sequence[Shot], time_s: Array) -> Any:
        """The images after the motion blur."""
        velocities = np.stack([shot.rotation_camera_from_site @ shot.velocity_mps for shot in shots])
        turns = np.stack([np.asarray(shot.angular_velocity_radps, np.float64) for shot in shots])
        motion = empty_on_device((*light.shape, 2), np.float32)
        moved = (sent_to_device(each * time_s[:, None]) for each in (velocities, turns))
        _motion[self._grid(light)](depth, self._lens, *moved, motion)
        longest = sent_to_device(np.zeros(len(shots), np.float32))
        _longest[len(shots), _THREADS](motion, longest)
        longest_px = np.sqrt(SharedArray(longest).to_host())
        nodes = [blur_nodes(float(px)) if px >= MIN_MOTION_PX else (np.empty(0), np.empty(0)) for px in longest_px]
        counts = np.array([len(times) for times, _ in nodes])
        if not counts.any():
            return light
        padded = np.zeros((2, len(shots), counts.max()))
        for k, pair in enumerate(nodes):
            padded[:, k, : counts[k]] = pair
        result = empty_on_device(light.shape, np.float32)
        _blur[self._grid(light)](light, motion, *map(sent_to_device, padded), sent_to_device(counts), result)
        return result

    @staticmethod
    def _grid(images: Any) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
        """Blocks and threads for one thread per pixel."""
        count, height, width = images.shape
        return (math.ceil(width / _SIDE), math.ceil(height / _SIDE), count), (_SIDE, _SIDE, 1)


def _constants(config: SensorConfig) -> _Sensor:
    largest = 2**config.bits - 1
    return _Sensor(
        config.responsivity_e_per_s,
        config.dark_current_e_per_s,
        config.read_noise_e,
        config.gain_nonuniformity,
        config.dark_nonuniformity_e,
        config.full_well_e,
        config.gain * largest / config.full_well_e,
        config.black_level_share * largest,
        float(largest),
    )


def _noise_key(shot: Shot) -> np.ndarray:
    """Key of the frame's noise (2,) uint64."""
    return stream(shot.seed, "sensor on a device", shot.index).integers(0, 2**64, 2, np.uint64)
