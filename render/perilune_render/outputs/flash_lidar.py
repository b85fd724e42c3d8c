"""Images of a flash lidar: ranges of all pixels at one time, with noise, dropouts and false returns.

The returned energy follows the lidar equation of an extended Lambertian target without atmosphere: it is proportional
to albedo x cos(incidence) / range^2 (Wagner et al. 2006, ISPRS Journal of Photogrammetry and Remote Sensing 60, 100).
Deviations: a pixel is one ray through its centre, so edges give no mixed ranges; the camera does not move during the
flash.
"""

from dataclasses import dataclass

import numpy as np

from perilune_render.config.outputs import FlashLidarConfig
from perilune_render.engines.frame_source import Shot
from perilune_render.engines.heightfield.query import first_returns
from perilune_render.engines.heightfield.surface import Surface
from perilune_render.imaging.exr import channel_bytes
from perilune_render.streams import stream
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array


@dataclass(frozen=True, slots=True)
class FlashImage:
    """Ranges and intensity of one flash, each (h, w)."""

    range_m: Array
    """Measured distances along the pixels' rays, metres; NaN without a return."""
    true_m: Array
    """True distances to ground or boulders, metres; NaN without a hit."""
    intensity: Array
    """Energy of the returns, as a multiple of the smallest detectable energy; NaN without a return."""

    def exr(self) -> bytes:
        """The content of an EXR file with the channels range, range_true and intensity."""
        return channel_bytes({"range": self.range_m, "range_true": self.true_m, "intensity": self.intensity})


def lidar_camera(config: FlashLidarConfig) -> Camera:
    """The pinhole camera that has the pixels of the lidar."""
    return Camera.from_field_of_view(config.width_px, config.height_px, config.horizontal_fov_deg)


def flash(surface: Surface, shot: Shot, config: FlashLidarConfig) -> FlashImage:
    """The image of the lidar at the pose of a shot; the noise depends only on the shot's seed and index."""
    camera = lidar_camera(config)
    rays = (camera.rays(camera.pixel_centres()) @ shot.rotation_camera_from_site).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance, normal, albedo = first_returns(surface, np.tile(shot.position_m, (len(rays), 1)), rays)
    cosine = np.maximum(-np.einsum("ij,ij->i", normal, rays), 0.0)
    energy = albedo * cosine * (config.threshold_range_m / distance) ** 2
    rng = stream(shot.seed, "flash lidar", shot.index)
    measured, energy, is_seen = _noisy(distance, energy, config, rng)
    shape = config.height_px, config.width_px
    nan = np.full(len(rays), np.nan)
    true = np.where(np.isfinite(distance), distance, nan)
    images = np.where(is_seen, measured, nan), true, np.where(is_seen, energy, nan)
    return FlashImage(*(image.reshape(shape) for image in images))


def _noisy(
    distance_m: Array, energy: Array, config: FlashLidarConfig, rng: np.random.Generator
) -> tuple[Array, Array, np.ndarray]:
    """Measured ranges, metres, energies, and whether there is a return (N,).

    The arguments are true distances, metres, and mean energies (N,).
    """
    n = len(distance_m)
    # Always draw all numbers in this order, so that no setting changes the noise that another setting controls.
    of_range, of_energy, is_false, false_m = rng.normal(size=n), rng.normal(size=n), rng.random(n), rng.random(n)
    energy = energy * (1 + config.energy_sigma_share * of_energy)
    measured = np.where(np.isfinite(distance_m), distance_m, 0.0)
    measured = measured + (config.range_sigma_m + config.range_sigma_share * measured) * of_range
    is_seen = np.isfinite(distance_m) & (energy >= 1)
    false = is_false < config.false_return_share
    measured, energy = np.where(false, false_m * config.max_range_m, measured), np.where(false, 1.0, energy)
    if config.quantisation_m > 0:
        measured = np.round(measured / config.quantisation_m) * config.quantisation_m
    return measured, energy, (is_seen | false) & (measured >= 0) & (measured <= config.max_range_m)
