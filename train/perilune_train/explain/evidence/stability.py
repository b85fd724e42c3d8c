"""Measure how similar attention masks stay if images change: noise, shifts, another lens, another rendering."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_train.explain.correlation.pearson import pearson_rows
from perilune_train.explain.maps.masks import Masks


@dataclass(frozen=True, slots=True)
class Changes:
    """Changes of images under which masks are compared."""

    noise_dn: tuple[float, ...] = (2.0, 5.0)
    """Standard deviations of added noise, in grey values (0 to 255)."""
    shifts_px: tuple[tuple[int, int], ...] = ((1, 0), (0, 1), (3, -2))
    """Shifts to the right and down, pixels."""
    lenses: tuple[float, ...] = (-0.05, 0.05)
    """Radial distortions: a point at half the image width from the centre moves outwards by this fraction of its
    distance. Negative values (barrel distortion) move it inwards."""


DEFAULT_CHANGES = Changes()
"""Noise, shifts and lenses of an explain run."""


def noisy(images: NDArray[np.uint8], sigma_dn: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Images with added Gaussian noise of standard deviation sigma_dn, rounded and limited to 0..255."""
    return np.clip(np.rint(images + rng.normal(0, sigma_dn, images.shape)), 0, 255).astype(np.uint8)


def shifted(images: NDArray, dx: int, dy: int) -> NDArray:
    """Images (..., height, width) moved dx pixels to the right and dy pixels down; edge pixels fill the gap."""
    height, width = images.shape[-2:]
    rows = np.clip(np.arange(height) - dy, 0, height - 1)
    columns = np.clip(np.arange(width) - dx, 0, width - 1)
    return images[..., rows[:, None], columns]


def lens_map(height: int, width: int, distortion: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """For each pixel of an image through another lens: the column and row (height, width) in the original image.

    r = r' (1 - distortion r'^2). r is the distance from the image centre in the original image and r' the distance in
    the new image, both in half image widths. Coordinate 0 is the centre of the first pixel, as in cv2.remap.
    """
    x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    factor = 1 - distortion * (x**2 + y**2) / (width / 2) ** 2
    column, row = x * factor + (width - 1) / 2, y * factor + (height - 1) / 2
    return column.astype(np.float32), row.astype(np.float32)


def stability(
    masks_of: Callable[[NDArray[np.uint8]], Masks],
    images: NDArray[np.uint8],
    rng: np.random.Generator,
    changes: Changes = DEFAULT_CHANGES,
    stacked: int = 1,
) -> pd.DataFrame:
    """Pearson correlation between attention masks of images (N, height, width) and of the changed images.

    Columns: map (name of the mask's gate), change ("noise 2 DN", "shift 3 -2 px", "lens -5 %"), frame_index, pearson
    (NaN if a mask is constant). A shift of the masks is undone before the comparison. For another lens (`lens_map`),
    the original masks are resampled as the images are. Only pixels that both images show are compared. `stacked` is the
    number of frames that are stacked in height in each image; each frame is changed separately.
    """
    before = masks_of(images)
    tables = []
    for sigma_dn in changes.noise_dn:
        tables.append(between(before, masks_of(noisy(images, sigma_dn, rng)), f"noise {sigma_dn:g} DN"))
    for dx, dy in changes.shifts_px:

        def moved(values: NDArray, dx: int = dx, dy: int = dy) -> NDArray:
            frames = values.reshape(-1, values.shape[1] // stacked, values.shape[2])
            return shifted(frames, dx, dy).reshape(values.shape)

        after = {name: moved(gate_masks, -dx, -dy) for name, gate_masks in masks_of(moved(images)).items()}
        # A pixel is in both images unless the shift filled it with an edge pixel.
        inside = np.zeros((images.shape[1] // stacked, images.shape[2]), bool)
        height, width = inside.shape
        inside[max(-dy, 0) : height - max(dy, 0), max(-dx, 0) : width - max(dx, 0)] = True
        seen = np.broadcast_to(np.tile(inside, (stacked, 1)), images.shape)
        tables.append(_compared(before, after, f"shift {dx} {dy} px", seen))
    for distortion in changes.lenses:
        maps = lens_map(images.shape[1] // stacked, images.shape[2], distortion)

        def bent(values: NDArray, maps: tuple = maps) -> NDArray:
            frames = values.reshape(-1, *maps[0].shape)
            x, y = maps
            changed = [cv2.remap(frame, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for frame in frames]
            return np.stack(changed).reshape(values.shape)

        inside = (maps[0] >= 0) & (maps[0] <= images.shape[2] - 1) & (maps[1] >= 0) & (maps[1] <= len(maps[0]) - 1)
        seen = np.broadcast_to(np.tile(inside, (stacked, 1)), images.shape)
        expected = {name: bent(gate_masks) for name, gate_masks in before.items()}
        tables.append(_compared(expected, masks_of(bent(images)), f"lens {100 * distortion:+g} %", seen))
    return pd.concat(tables, ignore_index=True)


def between(
    masks_a: Mapping[str, NDArray[np.floating]], masks_b: Mapping[str, NDArray[np.floating]], change: str
) -> pd.DataFrame:
    """Pearson correlation between the masks (N, height, width) of two renderings of the same poses.

    The columns are as in `stability`; `change` is the value of the column change.
    """
    return _compared(masks_a, masks_b, change, None)


def _compared(
    masks_a: Mapping[str, NDArray[np.floating]],
    masks_b: Mapping[str, NDArray[np.floating]],
    change: str,
    seen: NDArray[np.bool_] | None,
) -> pd.DataFrame:
    tables = []
    for name, before in masks_a.items():
        values = pearson_rows(before, masks_b[name], seen)
        columns = {"frame_index": np.arange(len(before)), "pearson": values}
        tables.append(pd.DataFrame({"map": name, "change": change, **columns}))
    return pd.concat(tables, ignore_index=True)
