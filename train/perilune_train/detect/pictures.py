"""One picture of anybody's as 8-bit grey: PNG, TIFF and JPEG of any size and depth."""

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from perilune_shared.errors import UserError

SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
_FORMATS = ("PNG", "TIFF", "JPEG")
_LARGEST_PIXELS = 2**29
"""A whole Narrow Angle Camera image has half of that; a small file may claim to unpack to any size."""
_STRETCH_PERCENT = (0.05, 99.95)
_SAMPLE = 1_000_000


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header alone. Raises UserError where it is no picture or too large."""
    with _opened(path) as picture:
        return picture.size


def picture_format(path: Path) -> str:
    """PNG, TIFF or JPEG, by the content. Raises UserError where it is none of these."""
    with _opened(path) as picture:
        return str(picture.format)


def read_grey(path: Path) -> NDArray[np.uint8]:
    """A picture's pixels (height, width) as 8-bit grey.

    8-bit grey stays as it is; colours become their luma. Deeper pictures (16 and 32 bit, float) are stretched so
    that 99.9 % of their values fall into 0..255: the network takes mean and deviation out anyway, and 16-bit files
    often use a small part of their range. What is not finite becomes 0. Raises UserError on a damaged file.
    """
    with _opened(path) as picture:
        try:
            deep = picture.mode.startswith(("I", "F"))
            pixels = np.asarray(picture if deep else picture.convert("L"))
        except (OSError, ValueError, SyntaxError, MemoryError) as error:
            raise UserError(path, "image", error, "a whole PNG, TIFF or JPEG") from None
    return _stretched(pixels) if deep else pixels.astype(np.uint8)


def _opened(path: Path) -> Image.Image:
    if not path.is_file():
        raise UserError(path, "image", "no such file", "a PNG, TIFF or JPEG")
    Image.MAX_IMAGE_PIXELS = None
    with warnings.catch_warnings():
        # Faults that matter raise; remarks about metadata would stand between the user and the result.
        warnings.simplefilter("ignore")
        try:
            picture = Image.open(path, formats=_FORMATS)
        except (OSError, ValueError, SyntaxError):
            raise UserError(path, "image", "a file that does not decode", "a PNG, TIFF or JPEG") from None
    width, height = picture.size
    if width * height > _LARGEST_PIXELS:
        picture.close()
        raise UserError(path, "size", f"{width} x {height}", f"at most {_LARGEST_PIXELS} pixels")
    return picture


def _stretched(pixels: NDArray) -> NDArray[np.uint8]:
    values = pixels.astype(np.float32)
    known = np.isfinite(values)
    sample = values[known][:: max(values.size // _SAMPLE, 1)]
    low, high = np.percentile(sample, _STRETCH_PERCENT) if len(sample) else (0.0, 1.0)
    grey = (np.where(known, values, low) - low) * (255 / max(float(high - low), 1e-12))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
