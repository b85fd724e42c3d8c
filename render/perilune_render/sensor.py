"""From radiance factor to grey values: point spread, exposure, shot and read noise, quantisation (EMVA 1288)."""

import cv2
import numpy as np

from perilune_render.config import SensorConfig


def develop(radiance_factor: np.ndarray, config: SensorConfig, rng: np.random.Generator) -> np.ndarray:
    """An 8-bit image (h, w) of a radiance factor (h, w).

    Exposure is automatic: a percentile of the blurred image lands at a share of the full well. Shot noise is Poisson in
    electrons, read noise Gaussian; the rest is clipped and rounded. Black stays black: no offset is added.
    """
    light = np.maximum(radiance_factor.astype(np.float32), 0)
    if config.psf_sigma_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), config.psf_sigma_px, borderType=cv2.BORDER_REFLECT)
    bright = float(np.percentile(light, config.exposure_percentile))
    electrons = light * (config.exposure_level * config.full_well_e / max(bright, 1e-6))
    # Above a hundred electrons a rounded Gaussian stands for the Poisson law, ten times faster; below, it is drawn.
    noisy = electrons + np.sqrt(electrons) * rng.standard_normal(electrons.shape, np.float32)
    faint = electrons < 100
    noisy[faint] = rng.poisson(electrons[faint])
    noisy += config.read_noise_e * rng.standard_normal(electrons.shape, np.float32)
    return np.clip(np.rint(noisy * (255 / config.full_well_e)), 0, 255).astype(np.uint8)
