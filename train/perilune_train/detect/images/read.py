"""Read an image as 8-bit grey: PNG, TIFF and JPEG of any size and depth.

Pillow reads most of them. It reduces 16-bit colours to 8 bits, so OpenCV reads such PNGs. rasterio (the extra `geo`)
reads TIFFs of float64 or with several bands deeper than 8 bits, since OpenCV misreads some of them.
"""

import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from perilune_shared.errors import UserError

SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
_FORMATS = ("PNG", "TIFF", "JPEG")
_LARGEST_PIXELS = 2**29
"""Largest number of pixels of an image: twice a whole Narrow Angle Camera image. The header of a small file can state
any size."""
_STRETCH_PERCENT = (0.05, 99.95)
_SAMPLE = 1_000_000
_LARGEST_VALUE = 1e30
"""Larger values are no measurements: ISIS marks missing data by values near the end of float32's range."""
_BITS_TAG, _NODATA_TAG = 258, 42113
_LUMA = (0.299, 0.587, 0.114)


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, read from the header only. Raises UserError if it is no image or too large."""
    with _opened(path) as picture:
        return picture.width, picture.height


def picture_format(path: Path) -> str:
    """PNG, TIFF or JPEG, by content. Raises UserError if it is none of these."""
    with _opened(path) as picture:
        return str(picture.format) if isinstance(picture, Image.Image) else "TIFF"


def read_grey(path: Path) -> NDArray[np.uint8]:
    """An image's pixels (height, width) as 8-bit grey.

    8-bit grey is not changed. Colours become their luma; of other bands the first is used. Deeper images (16 bits and
    more, float) are stretched so that 99.9 % of their values are within 0..255: the network removes mean and deviation
    anyway, and 16-bit files often use a small part of their range. Their values that are not finite, beyond 1e30 or
    equal to the file's own no-data value (GDAL_NODATA) are left out of the stretch and become 0. Raises UserError on a
    damaged file.
    """
    with _opened(path) as picture:
        try:
            pixels = _by_pillow(path, picture) if isinstance(picture, Image.Image) else _by_rasterio(picture)
        except (OSError, ValueError, SyntaxError, MemoryError, cv2.error) as error:
            raise UserError(path, "image", error, "a whole PNG, TIFF or JPEG") from None
    return pixels if pixels.dtype == np.uint8 else _stretched(pixels)


def _opened(path: Path) -> Any:
    """A Pillow image, or a rasterio dataset if Pillow does not suffice; both have a width and a height."""
    if not path.is_file():
        raise UserError(path, "image", "a folder" if path.is_dir() else "no such file", "a PNG, TIFF or JPEG")
    Image.MAX_IMAGE_PIXELS = None
    picture: Any
    with warnings.catch_warnings():
        # Serious errors raise an exception; warnings are about metadata only.
        warnings.simplefilter("ignore")
        try:
            picture = Image.open(path, formats=_FORMATS)
            bits = picture.tag_v2.get(_BITS_TAG, (1,)) if picture.format == "TIFF" else (1,)
        except (OSError, ValueError, SyntaxError):
            picture = _opened_by_rasterio(path)
        else:
            if len(bits) > 1 and max(bits) > 8:
                picture.close()
                picture = _opened_by_rasterio(path)
    width, height = picture.width, picture.height
    if width * height > _LARGEST_PIXELS:
        picture.close()
        raise UserError(path, "size", f"{width} x {height}", f"at most {_LARGEST_PIXELS} pixels")
    return picture


def _opened_by_rasterio(path: Path) -> Any:
    found, expected = "a file that cannot be decoded", "a PNG, TIFF or JPEG"
    try:
        import rasterio
        from rasterio.errors import RasterioError
    except ImportError:
        hint = "; float64 and deep colours in TIFF need rasterio (pip install 'perilune-train[geo]')"
        raise UserError(path, "image", found, expected + hint) from None
    try:
        # By default GDAL opens text files named .tif that refer to other files. PAM files can also refer to them.
        with rasterio.Env(GDAL_PAM_ENABLED="NO"):
            return rasterio.open(path.resolve(), driver="GTiff")
    except RasterioError:
        raise UserError(path, "image", found, expected) from None


def _by_pillow(path: Path, picture: Any) -> NDArray:
    """Pixels (height, width): uint8, or float with NaN where there is no data."""
    if picture.mode.startswith(("I", "F")):
        return _known(np.asarray(picture), _nodata(picture))
    if picture.format == "PNG" and ";16" in str(picture.tile[0][3]):
        # Load with Pillow first: it raises an error on damage, OpenCV only prints to standard error.
        picture.load()
        deep = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if deep is None or deep.dtype != np.uint16 or deep.ndim != 3:
            raise ValueError("16-bit colours that cannot be decoded")
        return _grey(deep[..., 2::-1].transpose(2, 0, 1).astype(np.float32))
    return np.asarray(picture.convert("L"))


def _by_rasterio(image: Any) -> NDArray:
    """Pixels as returned by `_by_pillow`."""
    from rasterio.enums import ColorInterp

    colours = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    kinds = list(image.colorinterp)
    indexes = [kinds.index(colour) + 1 for colour in colours] if all(colour in kinds for colour in colours) else [1]
    pixels = image.read(indexes)
    if pixels.dtype.kind == "c":
        raise ValueError("complex numbers")
    return _grey(pixels) if pixels.dtype == np.uint8 else _grey(_known(pixels, image.nodata))


def _grey(bands: NDArray) -> NDArray:
    """The only band of (1, height, width), or the luma of red, green and blue (3, height, width)."""
    if len(bands) == 1:
        return bands[0]
    luma = sum(weight * band for weight, band in zip(_LUMA, bands, strict=True))
    return np.rint(luma).astype(np.uint8) if bands.dtype == np.uint8 else np.asarray(luma)


def _nodata(picture: Any) -> float | None:
    """The value that GDAL's tag of a TIFF gives to pixels without data."""
    text = picture.tag_v2.get(_NODATA_TAG) if picture.format == "TIFF" else None
    try:
        return float(str(text).strip("\0 "))
    except ValueError:
        return None


def _known(pixels: NDArray, nodata: float | None) -> NDArray:
    """Pixels as float, NaN where there is no data."""
    values = pixels.astype(np.float64 if pixels.dtype == np.float64 else np.float32)
    values[~(np.abs(values) <= _LARGEST_VALUE)] = np.nan
    if nodata is not None and abs(nodata) <= _LARGEST_VALUE:
        values[values == nodata] = np.nan
    return values


def _stretched(values: NDArray) -> NDArray[np.uint8]:
    known = np.isfinite(values)
    sample = values[known]
    sample = sample[:: max(sample.size // _SAMPLE, 1)]
    low, high = np.percentile(sample, _STRETCH_PERCENT) if len(sample) else (0.0, 1.0)
    grey = (np.where(known, values, low) - low) * (255 / max(float(high - low), 1e-12))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
