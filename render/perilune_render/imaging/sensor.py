"""Sensor model, from radiance factor to grey values, by EMVA 1288 (release 4.0, linear).

Symbols: mu_p is the number of photons and eta mu_p the number of electrons in a pixel during the exposure time t, here
responsivity x t x I/F. mu_d and sigma_d are the mean and standard deviation of the dark signal, electrons. K is the
gain, grey values (DN) per electron. mu_y and sigma_y^2 are the temporal mean and variance of the grey value:

    mu_y = K (eta mu_p + mu_d) + black level,    mu_d = dark current x t
    sigma_y^2 = K^2 sigma_d^2 + 1/12 + K (mu_y - mu_y.dark),    sigma_d^2 = read noise^2 + mu_d

From pixel to pixel, eta varies by the PRNU, and mu_d varies by the DSNU and the hot pixels. All frames of one camera in
a dataset share this pattern.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.special import ive

from perilune_render.config.dataset import SensorConfig
from perilune_render.imaging.radiance import Radiance
from perilune_render.imaging.resampling import resample, resample_nearest
from perilune_render.streams import stream
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array

_STRETCH = 1.5
"""Approximate upper bound on the factor by which distortion stretches motion at the image edges."""
_SKY_M = 1e9
"""Depth assumed for pixels that show the sky, metres."""
MIN_MOTION_PX = 0.05
"""Motion during the exposure below which no blur is computed, pixels."""
FAINT_E = 100.0
"""Signal above which a rounded Gaussian approximates Poisson noise, electrons. It takes a tenth of the time."""
HOT_PIXEL_S = 0.002
"""Exposure time to which `hot_pixel_e` refers, seconds; the signal is proportional to the exposure time."""


@dataclass(frozen=True, slots=True)
class FixedPattern:
    """The fixed pattern noise of one sensor, shared by all its frames."""

    response: np.ndarray
    """Relative response of each pixel, mean 1 (h, w) float32."""
    offset_e: np.ndarray
    """Offset of each pixel, mean 0, electrons (h, w) float32."""
    hot_e: np.ndarray
    """Extra dark signal of the hot pixels in an exposure of HOT_PIXEL_S, 0 elsewhere, electrons (h, w) float32."""

    @classmethod
    def draw(cls, config: SensorConfig, camera: Camera, seed: int) -> "FixedPattern":
        """Draw the fixed pattern of a sensor from a random seed."""
        rng = stream(seed, "sensor")
        shape = camera.height_px, camera.width_px
        response = 1 + config.gain_nonuniformity * rng.standard_normal(shape, np.float32)
        offset = config.dark_nonuniformity_e * rng.standard_normal(shape, np.float32)
        hot = rng.random(shape, np.float32) < config.hot_pixel_share
        extra = config.hot_pixel_e * rng.standard_exponential(shape, np.float32)
        return cls(np.maximum(response, 0), offset, np.where(hot, extra, np.float32(0)))


@dataclass(frozen=True, slots=True)
class Exposure:
    """The light on the sensor in one frame, before noise and fixed pattern."""

    light: np.ndarray
    """Radiance factor I/F of each pixel after point spread and motion blur (h, w) float32."""
    time_s: float
    """Exposure time, seconds."""


def expose(
    radiance: Radiance,
    config: SensorConfig,
    camera: Camera,
    exr_camera: Camera,
    velocity_camera_mps: Array,
    angular_velocity_radps: Array | None = None,
) -> Exposure:
    """The light on the sensor of `camera`.

    The steps, in this order, are resampling, point spread, exposure time and motion blur. `radiance` is the rendering
    by `exr_camera` at the middle of the exposure. `velocity_camera_mps` (3,) and `angular_velocity_radps` (3,) are the
    velocity and the angular velocity of the camera in its axes O_C; None means no rotation.
    """
    light = _on_sensor(radiance.radiance_factor, config, camera, exr_camera)
    exposure_s = exposure_time_s(_on_ground(light, radiance.depth_m, camera, exr_camera), config)
    if radiance.blurred is not None:
        return Exposure(_on_sensor(radiance.blurred, config, camera, exr_camera), exposure_s)
    move_m = np.asarray(velocity_camera_mps) * exposure_s
    turn_rad = np.zeros(3) if angular_velocity_radps is None else angular_velocity_radps * exposure_s
    fastest_px = _fastest_px(radiance.depth_m, camera, exr_camera, move_m, turn_rad)
    if config.motion_blur and fastest_px >= MIN_MOTION_PX:
        depth_m = resample_nearest(radiance.depth_m, camera, exr_camera)
        light = _blurred(light, motion_px(depth_m, camera, move_m, turn_rad))
    return Exposure(light, exposure_s)


def time_of_exposure_s(radiance: Radiance, config: SensorConfig, camera: Camera, exr_camera: Camera) -> float:
    """Exposure time that `expose` uses, seconds."""
    light = _on_sensor(radiance.radiance_factor, config, camera, exr_camera)
    return exposure_time_s(_on_ground(light, radiance.depth_m, camera, exr_camera), config)


def _on_sensor(factor: np.ndarray, config: SensorConfig, camera: Camera, exr_camera: Camera) -> np.ndarray:
    """Radiance factor (h, w) in the pixels of `camera`, after the point spread."""
    light = np.maximum(resample(factor.astype(np.float32, copy=False), camera, exr_camera), 0)
    if config.psf_sigma_px > 0:
        kernel = psf_kernel(config.psf_sigma_px)
        light = cv2.sepFilter2D(light, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT)
    return light


@lru_cache(maxsize=4)
def psf_kernel(sigma_px: float) -> np.ndarray:
    """Weights (2 n + 1,) of the point spread along one axis: a discrete Gaussian of variance sigma_px^2.

    The weight at k pixels is exp(-t) I_k(t) with t = sigma_px^2 (Lindeberg 1990, doi 10.1109/34.49051). Its variance is
    t for every t, while a Gaussian sampled at the pixel centres loses variance if sigma is below about 0.7 px (0.45
    becomes 0.38). sigma_px does not include the average over the pixel's area, which the renderer computes.
    """
    half = int(np.ceil(6 * sigma_px + 4))
    weights = ive(np.abs(np.arange(-half, half + 1)), sigma_px**2)
    return weights / weights.sum()


def read_out(exposure: Exposure, config: SensorConfig, pattern: FixedPattern, rng: np.random.Generator) -> np.ndarray:
    """Grey image (h, w) of an exposure, DN from 0 to 2^bits - 1: uint8, or uint16 above 8 bits.

    Steps, in this order: electrons with PRNU, dark current and hot pixels, Poisson noise, read noise, DSNU, full well,
    gain, black level, rounding and clipping. `rng` draws the temporal noise only.
    """
    electrons = exposure.light * pattern.response
    electrons *= config.responsivity_e_per_s * exposure.time_s
    electrons += config.dark_current_e_per_s * exposure.time_s
    electrons += pattern.hot_e * np.float32(exposure.time_s / HOT_PIXEL_S)
    normal = rng.standard_normal(electrons.shape, np.float32)
    noisy = electrons + np.sqrt(electrons + np.float32(config.read_noise_e**2)) * normal
    faint = electrons < FAINT_E
    noisy[faint] = rng.poisson(electrons[faint]) + config.read_noise_e * normal[faint]
    noisy += pattern.offset_e
    largest = 2**config.bits - 1
    grey = np.minimum(noisy, config.full_well_e) * (config.gain * largest / config.full_well_e)
    grey += config.black_level_share * largest
    return np.clip(np.rint(grey), 0, largest).astype(np.uint8 if config.bits == 8 else np.uint16)


def expected(exposure: Exposure, config: SensorConfig) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (h, w) float32 of each grey value, DN.

    They are taken over temporal noise and fixed patterns. The variance is sigma_y^2 (module docstring) plus the
    variances of PRNU and DSNU, which act as noise in a single frame. Hot pixels are omitted. Clipping is ignored: where
    the sensor clips (in the brightest pixels, and in shadows with a black level of 0), the standard deviation is too
    large.
    """
    largest = 2**config.bits - 1
    per_e = config.gain * largest / config.full_well_e
    light_e = exposure.light * np.float32(config.responsivity_e_per_s * exposure.time_s)
    dark_e = config.dark_current_e_per_s * exposure.time_s
    mean = np.minimum(light_e + np.float32(dark_e), config.full_well_e) * per_e + config.black_level_share * largest
    still_e2 = config.read_noise_e**2 + config.dark_nonuniformity_e**2 + dark_e
    variance_e2 = light_e + np.square(config.gain_nonuniformity * light_e) + np.float32(still_e2)
    return np.clip(mean, 0, largest), np.sqrt(np.float32(per_e**2) * variance_e2 + np.float32(1 / 12))


def _on_ground(light: np.ndarray, depth_m: np.ndarray, camera: Camera, exr_camera: Camera) -> np.ndarray:
    """The pixels of an image (h, w) that show ground (finite depth); all pixels if none shows ground."""
    hit = np.isfinite(depth_m)
    if hit.all() or not hit.any():
        return light
    ground = resample_nearest(hit, camera, exr_camera)
    return light[ground] if ground.any() else light


def exposure_time_s(light: np.ndarray, config: SensorConfig) -> float:
    """Exposure time, seconds, for the radiance factors (...) of pixels.

    Automatic exposure brings the percentile `exposure_percentile` to the grey value `exposure_level`. It fills at most
    the share `exposure_level` of the full well and takes at most `longest_exposure_s`.
    """
    if config.exposure == "fixed":
        return config.exposure_time_s
    return exposure_time_of(float(np.percentile(light, config.exposure_percentile)), config)


def exposure_time_of(bright: float, config: SensorConfig) -> float:
    """Automatic exposure time, seconds, for the radiance factor at the percentile `exposure_percentile`."""
    share = min((config.exposure_level - config.black_level_share) / config.gain, config.exposure_level)
    rate = config.responsivity_e_per_s * bright + config.dark_current_e_per_s
    return min(share * config.full_well_e / max(rate, 1e-30), config.longest_exposure_s)


def motion_px(
    depth_m: np.ndarray, camera: Camera, move_camera_m: Array, turn_rad: Array | tuple[float, ...] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Motion of the ground in the image, pixels (h, w, 2) float32.

    `depth_m` (h, w) is the depth of the ground as in `Camera.points`, metres. The camera moves by `move_camera_m`
    (3,) in its axes O_C and rotates by the rotation vector `turn_rad` (3,) in these axes. The result is of first order
    in the rotation and in the ratio of motion to depth. Pixels of the sky (infinite depth) move only by the rotation.
    """
    if camera.lens is not None:
        points = camera.points(camera.pixel_centres(), np.where(np.isfinite(depth_m), depth_m, _SKY_M))
        after = points - move_camera_m - np.cross(np.asarray(turn_rad, np.float64), points)
        return np.nan_to_num(camera.project(after) - camera.project(points)).astype(np.float32)
    rays = _rays(camera)
    step = np.asarray(move_camera_m, np.float32)
    move = (rays * step[2] - step[:2]) / depth_m[..., None]
    if np.any(turn_rad):
        move += _turned(rays, np.asarray(turn_rad, np.float32))
    if not camera.distorts:
        return move * np.array([camera.fx_px, camera.fy_px], np.float32)
    moved = np.concatenate([rays + move, np.ones_like(depth_m)[..., None]], axis=-1)
    start = np.concatenate([rays, np.ones_like(depth_m)[..., None]], axis=-1)
    # At the limit of the distortion model, the end of the motion may have no image.
    return np.nan_to_num(camera.project(moved) - camera.project(start)).astype(np.float32)


def _turned(rays: np.ndarray, turn_rad: np.ndarray) -> np.ndarray:
    """Motion (h, w, 2) of rays (h, w, 2), both divided by z, if the camera rotates by `turn_rad` (3,)."""
    x, y = rays[..., 0], rays[..., 1]
    a, b, c = turn_rad
    along = a * y - b * x
    return np.stack([x * along - b + c * y, y * along + a - c * x], axis=-1)


def _fastest_px(depth_m: np.ndarray, camera: Camera, pinhole: Camera, move_camera_m: Array, turn_rad: Array) -> float:
    """Approximate upper bound on the motion of any pixel of `camera`, pixels; `pinhole` covers its view."""
    corners = [[u, v] for u in (0, pinhole.width_px) for v in (0, pinhole.height_px)]
    widest = 1.0 if camera.lens is not None else np.linalg.norm(pinhole.rays(corners), axis=-1).max()
    nearest_m = max(float(depth_m.min()), 1e-9)
    share = np.linalg.norm(move_camera_m) / nearest_m + np.linalg.norm(turn_rad) * widest
    focal_px = camera.scale_px if camera.lens is not None else max(camera.fx_px, camera.fy_px)
    return float(share * widest * focal_px * _STRETCH)


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> np.ndarray:
    """Ray (h, w, 2) float32 of each pixel centre: x and y divided by z in O_C."""
    return camera.rays(camera.pixel_centres())[..., :2].astype(np.float32)


def _blurred(light: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """The mean of an image over an exposure during which its content moves by `motion` (h, w, 2), pixels."""
    longest = float(np.sqrt(np.square(motion).sum(axis=-1).max()))
    if longest < MIN_MOTION_PX:
        return light
    times, weights = blur_nodes(longest)
    column, row = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in light.shape[::-1]))
    mean = np.zeros_like(light)
    for time, weight in zip(times, weights, strict=True):
        source_px = column - np.float32(time) * motion[..., 0], row - np.float32(time) * motion[..., 1]
        mean += np.float32(weight) * cv2.remap(light, *source_px, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    return np.maximum(mean, 0)


def blur_nodes(longest_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Times, in exposures from the middle, and weights (n,) of the images that make a blur of this length.

    They are Gauss-Legendre nodes. Two are enough for the correct width of a short blur.
    """
    times, weights = np.polynomial.legendre.leggauss(int(min(2 * longest_px, 126)) + 2)
    return times / 2, weights / 2
