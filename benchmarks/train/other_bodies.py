"""Drawn frames of ground that is not the Moon's: cracked ice, clouds, bricks, dunes, pebbles, scales.

Each function returns grey levels (side, side). All are lit from one side where they have relief, so that the check of
the light (detect/images/one_light.py) has no easy case.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator, int], Array]


def clouds(rng: np.random.Generator, side: int) -> Array:
    """Noise whose power falls as frequency^-2.2 to -3."""
    return _noise(rng, side, rng.uniform(2.2, 3.0))


def cracked_ice(rng: np.random.Generator, side: int) -> Array:
    """Plates of different grey levels, parted by dark cracks."""
    nearest, second, plate = _cells(rng, side, int(rng.integers(15, 60)))
    level = rng.uniform(0.7, 1.0, int(plate.max()) + 1)[plate]
    crack = np.exp(-(((second - nearest) / rng.uniform(1.5, 3.5)) ** 2))
    return level * (1 - 0.8 * crack) + 0.04 * _noise(rng, side, 1.5)


def bricks(rng: np.random.Generator, side: int) -> Array:
    """Rows of bricks with mortar, turned by any angle."""
    x, y = _turned(rng, side)
    height = rng.uniform(16, 40)
    width, row = 2.2 * height, np.floor(y / height)
    x = x + 0.5 * width * (row % 2)
    mortar = np.minimum(np.minimum(x % width, width - x % width), np.minimum(y % height, height - y % height)) < 2
    level = rng.uniform(0.4, 0.8, 997)[((row * 31 + np.floor(x / width)) % 997).astype(int)]
    return np.where(mortar, 0.95, level) + 0.05 * _noise(rng, side, 1.0)


def dunes(rng: np.random.Generator, side: int) -> Array:
    """Ripples with curved crests, shaded by a Sun at one side."""
    x, _ = _turned(rng, side)
    phase = x / rng.uniform(8, 24) * 2 * np.pi + 2.5 * _noise(rng, side, 3.0)
    height = np.abs(np.sin(phase / 2)) ** 0.7 + 0.02 * _noise(rng, side, 2.0)
    return _shaded(cv2.GaussianBlur(height, (0, 0), 1.0), rng)


def pebbles(rng: np.random.Generator, side: int) -> Array:
    """Round stones side by side, shaded by a Sun at one side."""
    nearest, second, _ = _cells(rng, side, int(rng.integers(150, 700)))
    height = np.sqrt(np.clip(second - nearest, 0, None)) + 0.1 * _noise(rng, side, 2.0)
    return _shaded(cv2.GaussianBlur(height, (0, 0), 0.8), rng)


def scales(rng: np.random.Generator, side: int) -> Array:
    """Overlapping round scales in rows, as of a fish."""
    x, y = _turned(rng, side)
    size = rng.uniform(10, 28)
    row = np.floor(y / size)
    x = x + 0.5 * size * (row % 2)
    distance = np.hypot((x % size) / size - 0.5, (y % size) / size)
    return np.where(distance < 0.62, 0.9 - 0.7 * distance, 0.3) + 0.05 * _noise(rng, side, 1.5)


CHOICE: dict[str, Draw] = {"cracked ice": cracked_ice, "clouds": clouds, "bricks": bricks}
"""Textures on which a score may be chosen."""
TEST: dict[str, Draw] = {"dunes": dunes, "pebbles": pebbles, "scales": scales}
"""Textures of the test."""


def frames_of(draw: Draw, count: int, side: int = 256) -> NDArray[np.uint8]:
    """Frames (count, side, side) of a texture, with the contrast and a noise of 2 levels as rendered frames have."""
    images = np.empty((count, side, side), np.uint8)
    for number in range(count):
        rng = np.random.default_rng([number, side])
        grey = draw(rng, side)
        low, high = np.quantile(grey, [0.01, 0.99])
        levels = 30 + 170 * (grey - low) / max(float(high - low), 1e-9) + 2 * rng.standard_normal(grey.shape)
        images[number] = np.clip(np.rint(levels), 0, 255)
    return images


def _noise(rng: np.random.Generator, side: int, slope: float) -> Array:
    """Noise of deviation 1 whose power is proportional to frequency^-slope."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    frequency[0, 0] = np.inf
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((side, side))) * frequency ** (-slope / 2), s=(side, side))
    return np.asarray(field / field.std())


def _cells(rng: np.random.Generator, side: int, count: int) -> tuple[Array, Array, NDArray[np.intp]]:
    """Distances to the nearest and the second nearest of random points, pixels, and the number of the nearest."""
    points = rng.uniform(-20, side + 20, (count, 2))
    y, x = np.mgrid[:side, :side]
    distance = np.hypot(x[..., None] - points[:, 0], y[..., None] - points[:, 1])
    order = np.partition(distance, 1, axis=2)
    return order[..., 0], order[..., 1], distance.argmin(axis=2)


def _turned(rng: np.random.Generator, side: int) -> tuple[Array, Array]:
    """Coordinates of all pixels in axes that are turned by a random angle."""
    angle = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[:side, :side] + rng.uniform(1000, 2000, 2)[:, None, None]
    return x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)


def _shaded(height: Array, rng: np.random.Generator) -> Array:
    """Slope towards a Sun in a random direction; half of the slopes are in shadow at most."""
    angle = rng.uniform(0, 2 * np.pi)
    slope_y, slope_x = np.gradient(height / height.std())
    return np.clip(1 + 3 * (slope_x * np.cos(angle) + slope_y * np.sin(angle)), 0, None)
