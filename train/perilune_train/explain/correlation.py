"""Pearson correlations of attention masks: PCC1 to PCC4 of the paper (section "Explainability analysis")."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.frames import Array
from perilune_train.navigate.geometry import pixel_index_homography


def pearson(a: ArrayLike, b: ArrayLike, seen: NDArray[np.bool_] | None = None) -> float:
    """Pearson correlation of two images over the pixels `seen`; NaN if one is constant or no pixel is seen."""
    x, y = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if x.shape != y.shape:
        raise ValueError(f"shapes {x.shape} and {y.shape} differ")
    keep = slice(None) if seen is None else seen
    if x[keep].size == 0:
        return float("nan")
    return float(_standardised(x[keep].ravel()) @ _standardised(y[keep].ravel()))


def pearson_between(images: NDArray[np.floating]) -> Array:
    """Correlations (N, N) of N images (N, ...) with each other; NaN in rows and columns of constant ones."""
    flat = np.stack([_standardised(np.asarray(image, np.float64).ravel()) for image in images])
    return flat @ flat.T


def mean_between(correlations: Array) -> tuple[float, int]:
    """PCC2: mean of the correlations (N, N) between different images, NaN left out, and the number of NaN.

    The paper pairs each image n with one unspecified m != n; here all m are used.
    """
    apart = correlations[~np.eye(len(correlations), dtype=bool)]
    return mean_defined(apart)


def mean_defined(values: ArrayLike) -> tuple[float, int]:
    """Mean of the values that are not NaN (NaN if there are none), and the number of NaN."""
    array = np.asarray(values, np.float64)
    undefined = int(np.isnan(array).sum())
    return (float(np.nanmean(array)) if undefined < array.size else float("nan")), undefined


def is_constant(values: ArrayLike) -> bool:
    """Whether the standard deviation of the values is at most 1e-6 of the largest absolute value, a rounding error."""
    array = np.asarray(values, np.float64)
    return bool(np.std(array) <= 1e-6 * max(float(np.abs(array).max()), 1e-30))


def ground_truth_mask(
    width_px: int, height_px: int, centres_px: ArrayLike, radii_px: ArrayLike, ring_factors: tuple[float, ...]
) -> Array:
    """The paper's mask G (height, width): 0 in craters, 0.2, 0.4, 0.6, 0.8 in rings around them, 1 elsewhere.

    Takes centres (N, 2) and radii (N,) in pixels; the rings end at ring_factors times the radius (equation
    "crater_width"). Where craters overlap, the smallest value is used; the paper does not define this case. The paper's
    text calls the craters white and the background black, which contradicts its numbers; this code uses the numbers.
    """
    mask = np.ones((height_px, width_px))
    levels = np.arange(len(ring_factors) + 1) / (len(ring_factors) + 1)
    for (x, y), radius in zip(np.asarray(centres_px, np.float64).reshape(-1, 2), np.asarray(radii_px), strict=True):
        reach = radius * ring_factors[-1]
        left, right = max(int(x - reach), 0), min(int(x + reach) + 1, width_px)
        top, bottom = max(int(y - reach), 0), min(int(y + reach) + 1, height_px)
        if left >= right or top >= bottom:
            continue
        u, v = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
        distance = np.hypot(u - x, v - y) / radius
        value = np.append(levels, 1.0)[np.searchsorted([1.0, *ring_factors], distance)]
        part = mask[top:bottom, left:right]
        np.minimum(part, value, out=part)
    return mask


def ground_affine(
    camera: Camera,
    position_1_m: Array,
    rotation_1_camera_from_site: Array,
    position_2_m: Array,
    rotation_2_camera_from_site: Array,
    grid: int = 9,
) -> Array:
    """The affine map (2, 3) from image coordinates of frame 1 to those of frame 2 that best fits the true poses.

    Least squares over a grid of pixels of frame 1 whose rays meet the ground plane z = 0 of O_L. The paper mentions
    "the affine transformation matrix defined by groundtruth pose" without a definition; between near-vertical views of
    a plane the fit is close to the exact homography.
    """
    u, v = np.meshgrid(np.linspace(0, camera.width_px, grid), np.linspace(0, camera.height_px, grid))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = camera.rays(pixels) @ rotation_1_camera_from_site
    downward = rays[:, 2] < 0
    ground = position_1_m - rays[downward] * (position_1_m[2] / rays[downward, 2])[:, None]
    found = camera.project(camera_from_site(ground, position_2_m, rotation_2_camera_from_site))
    good = np.isfinite(found).all(axis=1)
    if good.sum() < 3:
        raise ValueError("the frames share no ground")
    known = np.column_stack([pixels[downward][good], np.ones(good.sum())])
    return np.linalg.lstsq(known, found[good], rcond=None)[0].T


def warped_mask(mask: NDArray[np.floating], affine: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Resample a mask of frame 2 (height, width) to frame 1; also returns which pixels of frame 1 are in frame 2.

    `affine` (2, 3) maps image coordinates of frame 1 to frame 2.
    """
    square = pixel_index_homography(np.vstack([affine, [0, 0, 1]]))[:2]
    height, width = mask.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(
        np.asarray(mask, np.float64), square, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x = affine[0, 0] * u + affine[0, 1] * v + affine[0, 2]
    y = affine[1, 0] * u + affine[1, 1] * v + affine[1, 2]
    return warped, (x >= 0) & (x < width) & (y >= 0) & (y < height)


def _standardised(values: Array) -> Array:
    """Values (n,) shifted to mean 0 and scaled to length 1, so that a product is a correlation; NaN if constant."""
    if is_constant(values):
        return np.full_like(values, np.nan)
    centred = values - values.mean()
    return centred / np.linalg.norm(centred)
