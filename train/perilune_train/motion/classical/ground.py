"""Heights of the ground in view of a camera: a coarse grid with a Gaussian process as prior."""

from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array

N_SIDE = 5
"""Number of nodes along each side of the image."""
N_NODES = N_SIDE**2
_HEIGHT_SHARE = 0.01
"""Standard deviation of the heights, divided by altitude."""
_LENGTH_SHARE = 0.35
"""Correlation length of the heights, divided by the width of the ground in view."""
_NEW_SHARE = 0.03
"""Share of the estimated heights that the prior replaces from one frame to the next, since finer relief comes into
view."""


@dataclass(frozen=True, slots=True)
class Heights:
    """Heights above the ground plane at the nodes of a grid over the image."""

    mean_m: Array
    """Expected heights (N_NODES,), metres."""
    covariance_m2: Array
    """Their covariance (N_NODES, N_NODES), square metres."""


def node_pixels(camera: Camera) -> Array:
    """Image coordinates (N_NODES, 2) of the nodes, row by row; the outer ones lie on the edge of the image."""
    u, v = np.meshgrid(np.linspace(0, camera.width_px, N_SIDE), np.linspace(0, camera.height_px, N_SIDE))
    return np.stack([u.ravel(), v.ravel()], axis=1)


def node_weights(camera: Camera, pixels: Array) -> Array:
    """Bilinear weights (n, N_NODES) of the nodes at image coordinates (n, 2)."""
    node = pixels / np.array([camera.width_px, camera.height_px]) * (N_SIDE - 1)
    across, down = (np.clip(1 - np.abs(node[:, k, None] - np.arange(N_SIDE)), 0, None) for k in (0, 1))
    return (down[:, :, None] * across[:, None, :]).reshape(len(pixels), N_NODES).astype(np.float32)


def unknown_heights(camera: Camera, down_c: Array, altitude_m: float) -> Heights:
    """Prior of the heights: mean 0, with the covariance of the Gaussian process."""
    ground = ground_points(camera, node_pixels(camera), down_c, altitude_m)
    return Heights(np.zeros(N_NODES), _kernel(camera, altitude_m, ground, ground))


def ground_points(camera: Camera, pixels: Array, down_c: Array, altitude_m: float) -> Array:
    """Points (n, 3), O_C, at which the rays of pixels (n, 2) meet the ground plane."""
    rays = camera.rays(pixels)
    return rays * (altitude_m / (rays @ down_c))[:, None]


def carried(
    heights: Heights,
    camera: Camera,
    downs_c: tuple[Array, Array],
    altitudes_m: tuple[float, float],
    motion: tuple[Array, Array],
) -> Heights:
    """Predict the heights at the nodes of frame 2 from the heights at the nodes of frame 1.

    This is a regression with the covariance of the prior. `downs_c` and `altitudes_m` belong to frames 1 and 2;
    `motion` is translation_m and rotation_c2_from_c1.
    """
    translation, rotation_c2_from_c1 = motion
    nodes = node_pixels(camera)
    first = ground_points(camera, nodes, downs_c[0], altitudes_m[0])
    second = ground_points(camera, nodes, downs_c[1], altitudes_m[1]) @ rotation_c2_from_c1 + translation
    among, between, within = (
        _kernel(camera, altitudes_m[0], a, b) for a, b in ((first, first), (second, first), (second, second))
    )
    regression = np.linalg.solve(among, between.T).T
    mean = regression @ heights.mean_m
    covariance = within - regression @ (among - heights.covariance_m2) @ regression.T
    kept = 1 - _NEW_SHARE
    new = unknown_heights(camera, downs_c[1], altitudes_m[1]).covariance_m2
    return Heights(kept * mean, kept**2 * covariance + (1 - kept**2) * new)


def _kernel(camera: Camera, altitude_m: float, a: Array, b: Array) -> Array:
    """Prior covariance of heights at points (n, 3) and (m, 3): a Matern kernel of order 3/2."""
    length = _LENGTH_SHARE * altitude_m * camera.width_px / camera.fx_px
    distance = np.sqrt(3) * np.linalg.norm(a[:, None] - b[None], axis=2) / length
    return (_HEIGHT_SHARE * altitude_m) ** 2 * (1 + distance) * np.exp(-distance)
