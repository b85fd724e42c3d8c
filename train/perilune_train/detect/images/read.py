"""Read a picture as 8-bit grey: PNG, TIFF, JPEG, JPEG 2000, ISIS cubes and PDS, of any size and depth.

Pillow reads PNG, JPEG and 8-bit TIFF. OpenCV reads PNG with 16-bit colours, which Pillow would reduce to 8 bits.
rasterio (the extra `geo`) reads all other files, strip by strip; without it, Pillow reads 16-bit and float32 TIFF.
Pixels are turned upright (orientation.py).
"""

import contextlib
import importlib.util
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from perilune_shared.console.terminal import say
from perilune_shared.errors import UserError
from perilune_shared.storage.rasters import PICTURE_DRIVERS, opened_raster, raster_files
from perilune_train.detect.images.orientation import (
    is_turned,
    orientation_of,
    stored_coordinates,
    tiff_orientation,
    tiff_tags,
    upright,
)
from perilune_train.detect.images.stretch import MAX_VALUE, SAMPLE, Stretch, stretch_of

SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".jp2", ".img", ".cub", ".lbl")
_KINDS = {"GTiff": "TIFF", "JP2OpenJPEG": "JPEG 2000", "ISIS3": "ISIS cube", "PDS": "PDS3"}
MAX_PIXELS = 2**29
"""Largest number of pixels of an image: twice the number of a whole Narrow Angle Camera image. A limit is needed,
because the header of a small file can state any size."""
MAX_DECODED = 2**30
"""Largest decoded size, bytes, of a picture that is decoded as a whole; only rasterio reads larger pictures."""
_FORMATS = ("PNG", "TIFF", "JPEG")
_BITS_TAG, _PHOTOMETRIC_TAG, _SAMPLE_FORMAT_TAG, _NODATA_TAG = 258, 262, 339, 42113
_WHITE_IS_ZERO, _SIGNED = 0, 2
_LUMA = (0.299, 0.587, 0.114)
_STRIP_PIXELS = 2**22
_CACHE_MB = 64


@dataclass(frozen=True)
class _Picture:
    """An opened picture."""

    path: Path
    """The file."""
    width_px: int
    """Width as decoded, pixels."""
    height_px: int
    """Height as decoded, pixels."""
    orientation: int
    """Orientation tag, 1 to 8 (orientation.py)."""
    is_upright: bool
    """Whether the decoder turns the pixels upright, as Pillow does for TIFF."""
    white_is_zero: bool
    """Whether larger values are darker in the decoder's output."""
    nodata: float | None
    """Value of pixels without data, as stated in the file."""
    strips: Callable[[], Iterator[NDArray]]
    """Function that reads the picture in strips (1 or 3 bands, rows, width), from top to bottom."""

    def size_px(self, upright: bool) -> tuple[int, int]:
        """Width and height, pixels, of the upright or the stored picture."""
        swapped = is_turned(self.orientation) and upright != self.is_upright
        return (self.height_px, self.width_px) if swapped else (self.width_px, self.height_px)


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of the upright picture, pixels, from the header.

    Raises UserError if the file is not a picture or is too large.
    """
    with _opened(path) as picture:
        return picture.size_px(upright=True)


def stored_from_upright(path: Path) -> NDArray[np.float64]:
    """Matrix (2, 3) that converts pixel coordinates of the upright picture to the stored picture."""
    with _opened(path) as picture:
        return stored_coordinates(picture.orientation, *picture.size_px(upright=False))


def stored_size(path: Path) -> tuple[int, int]:
    """Width and height of the picture as it is stored, pixels."""
    with _opened(path) as picture:
        return picture.size_px(upright=False)


def read_grey(path: Path, nodata: float | None = None, quiet: bool = False) -> NDArray[np.uint8]:
    """Read the upright picture's pixels (height, width) as 8-bit grey.

    8-bit grey is not changed. Red, green and blue become luma; of other bands, the first is used. Deeper images (16
    bits and more, float) are stretched so that 99.9 % of their values are within 0..255. The stretch loses little: the
    network removes mean and deviation anyway, and 16-bit files often use a small part of their range.

    Pixels without data do not affect the stretch and become 0. Their values are not finite, beyond 1e30, or equal to
    the file's no-data value or to `nodata`. If neither is given, stretch.py may take other values of a deep image as
    missing data; a message names these values unless `quiet`. Raises UserError on a damaged file.
    """
    with _opened(path) as picture:
        grey = np.empty((picture.height_px, picture.width_px), np.uint8)
        stretch, top = None, 0
        for bands in picture.strips():
            if bands.dtype != np.uint8 and stretch is None:
                stretch = _stretch(picture, nodata)
            rows = slice(top, top := top + bands.shape[1])
            grey[rows] = _grey_of(bands, picture, nodata, stretch)
        if stretch is not None and stretch.fills and not quiet:
            values = ", ".join(f"{fill:g}" for fill in stretch.fills)
            fills = f"{stretch.fill_share:.1%} of the pixels are {values}, far from all others"
            say(f"{path.name}: {fills}: taken as no data (--nodata sets the value)")
        return grey if picture.is_upright else upright(grey, picture.orientation)


def grey_of_array(pixels: NDArray, where: object = "image") -> NDArray[np.uint8]:
    """Convert pixels (height, width) or (height, width, 1, 3 or 4) to 8-bit grey, as `read_grey` does.

    Colours are red, green, blue; a fourth band is ignored. Raises UserError on other shapes or types.
    """
    kind = pixels.dtype.kind
    if kind not in "buif" or pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] not in (1, 3, 4)):
        got, expected = f"{pixels.dtype} of shape {pixels.shape}", "numbers (height, width) or (height, width, 3)"
        raise UserError(where, "pixels", got, expected)
    if pixels.size == 0 or pixels.size > MAX_PIXELS:
        raise UserError(where, "pixels", f"shape {pixels.shape}", f"1 to {MAX_PIXELS} pixels")
    bands = [pixels] if pixels.ndim == 2 else [pixels[..., k] for k in range(3 if pixels.shape[2] > 1 else 1)]
    if pixels.dtype in (np.bool_, np.uint8):
        grey = np.rint(_luma(np.stack(bands))) if len(bands) > 1 else bands[0] * (255 if kind == "b" else 1)
        return np.ascontiguousarray(grey, np.uint8)
    small = pixels.dtype.itemsize <= 2 or pixels.dtype == np.float32
    values = np.stack(bands).astype(np.float32 if small else np.float64)
    values[~(np.abs(values) <= MAX_VALUE)] = np.nan
    values = _luma(values) if len(bands) > 1 else values[0]
    known = values[np.isfinite(values)]
    return stretch_of(known[:: max(known.size // SAMPLE, 1)], find_fills=True).grey(values)


def _grey_of(bands: NDArray, picture: _Picture, nodata: float | None, stretch: Stretch | None) -> NDArray[np.uint8]:
    if stretch is not None:
        return stretch.grey(_values(bands, picture, nodata))
    missing = None if nodata is None else (bands == nodata).all(axis=0)
    grey = np.rint(_luma(bands)).astype(np.uint8) if len(bands) > 1 else bands[0]
    if picture.white_is_zero:
        grey = np.uint8(255) - grey
    return grey if missing is None else np.where(missing, np.uint8(0), grey)


def _stretch(picture: _Picture, nodata: float | None) -> Stretch:
    """The stretch of a picture, computed from a sample of its pixels."""
    step = max(picture.width_px * picture.height_px // SAMPLE, 1)
    sample, start = [], 0
    for bands in picture.strips():
        every = bands.reshape(len(bands), 1, -1)
        values = _values(every[..., -start % step :: step], picture, nodata).ravel()
        sample.append(values[np.isfinite(values)])
        start += every.shape[-1]
    declared = nodata is not None or picture.nodata is not None
    return stretch_of(np.concatenate(sample), find_fills=not declared)


def _values(bands: NDArray, picture: _Picture, nodata: float | None) -> NDArray:
    """Bands (1 or 3, rows, width) as float grey (rows, width): larger is brighter, NaN is missing data."""
    if bands.dtype.kind == "c":
        raise UserError(picture.path, "image", "complex numbers", "real numbers")
    # float32 holds all 16-bit values; 32-bit values need float64.
    small = bands.dtype.itemsize <= 2 or bands.dtype == np.float32
    values = bands.astype(np.float32 if small else np.float64)
    values[~(np.abs(values) <= MAX_VALUE)] = np.nan
    for missing in (nodata, picture.nodata):
        if missing is not None and abs(missing) <= MAX_VALUE:
            values[values == (np.float32(missing) if values.dtype == np.float32 else missing)] = np.nan
    grey = _luma(values) if len(values) > 1 else values[0]
    return -grey if picture.white_is_zero else grey


def _luma(bands: NDArray) -> NDArray:
    return np.asarray(sum(weight * band for weight, band in zip(_LUMA, bands, strict=True)))


@contextmanager
def _opened(path: Path) -> Iterator[_Picture]:
    """Open a picture by its content.

    Raises UserError if the file is not a picture, or if reading within the block finds damage.
    """
    driver = raster_files(path, PICTURE_DRIVERS, "image").driver
    by_pillow = driver in ("GTiff", "PNG", "JPEG")
    has_rasterio = importlib.util.find_spec("rasterio") is not None
    if not by_pillow and not has_rasterio:
        expected = "rasterio, which reads this format (pip install 'perilune-train[geo]')"
        raise UserError(path, "image", f"{_KINDS.get(driver, driver)} without rasterio", expected)
    tags = tiff_tags(path) if driver == "GTiff" else {}
    with contextlib.ExitStack() as stack:
        opened = None
        if by_pillow and not (has_rasterio and _is_deep_or_signed(tags)):
            opened = _pillow_image(path, stack)
        if opened is not None:
            yield _by_pillow(path, opened, tags)
        elif driver == "GTiff" and not has_rasterio:
            expected = "an 8-bit TIFF, or rasterio, which reads all (pip install 'perilune-train[geo]')"
            raise UserError(path, "image", "a file that cannot be decoded", expected)
        else:
            yield stack.enter_context(_by_rasterio(path, driver, tags))


def _pillow_image(path: Path, stack: contextlib.ExitStack) -> Any:
    """Open an image with Pillow; None if Pillow does not support this kind of image."""
    stack.enter_context(warnings.catch_warnings())
    # Serious errors raise an exception; warnings concern metadata only.
    warnings.simplefilter("ignore")
    Image.MAX_IMAGE_PIXELS = None
    # Pass a file object: given a path, Pillow memory-maps uncompressed TIFF files, and reads rotated ones wrongly.
    file = stack.enter_context(path.open("rb"))
    try:
        return stack.enter_context(Image.open(file, formats=_FORMATS))
    except (OSError, ValueError, SyntaxError):
        return None


def _bits(tags: dict[int, Any]) -> tuple[int, ...]:
    bits = tags.get(_BITS_TAG, (1,))
    bits = bits if isinstance(bits, tuple) else (bits,)
    return tuple(value for value in bits if isinstance(value, int)) or (1,)


def _is_deep_or_signed(tags: dict[int, Any]) -> bool:
    """Whether a TIFF has more than 8 bits, or signed numbers: Pillow reads only some of these."""
    kinds = tags.get(_SAMPLE_FORMAT_TAG, (1,))
    return max(_bits(tags)) > 8 or _SIGNED in (kinds if isinstance(kinds, tuple) else (kinds,))


def _by_pillow(path: Path, opened: Any, tags: dict[int, Any]) -> _Picture:
    kind = "JPEG" if opened.format == "MPO" else str(opened.format)
    bytes_per_pixel = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2, "I;16L": 2}.get(opened.mode, 4)
    orientation = tiff_orientation(tags) if kind == "TIFF" else orientation_of(opened, path)
    deep_colours = kind == "PNG" and bool(opened.tile) and ";16" in str(opened.tile[0][3]) and opened.mode != "I;16"
    _check_size(path, opened.width, opened.height, 10 if deep_colours else bytes_per_pixel)

    def strips() -> Iterator[NDArray]:
        try:
            yield from decoded()
        except (OSError, ValueError, SyntaxError, MemoryError, EOFError, cv2.error) as error:
            raise UserError(path, "image", error, f"a whole {kind}") from None

    def decoded() -> Iterator[NDArray]:
        opened.load()
        deep = _deep_colours(path) if deep_colours else None
        rows = max(_STRIP_PIXELS // opened.width, 1)
        for top in range(0, opened.height, rows):
            bottom = min(top + rows, opened.height)
            if deep is not None:
                yield deep[top:bottom, :, 2::-1].transpose(2, 0, 1)
                continue
            part = opened.crop((0, top, opened.width, bottom))
            values = np.asarray(part if part.mode.startswith(("I", "F")) else part.convert("L"))
            if kind == "TIFF" and part.mode == "I" and tags.get(_SAMPLE_FORMAT_TAG, (1,)) in (1, (1,)):
                # Pillow reads unsigned integers of 32 bits as signed integers.
                values = values.view(np.uint32)
            yield values[None]

    deep_tiff = kind == "TIFF" and opened.mode.startswith(("I", "F"))
    inverted = deep_tiff and tags.get(_PHOTOMETRIC_TAG) == _WHITE_IS_ZERO
    # Pillow gives the upright size of a TIFF, and turns its pixels when it loads them.
    size = opened.width, opened.height
    return _Picture(path, *size, orientation, kind == "TIFF", inverted, _nodata(tags), strips)


def _deep_colours(path: Path) -> NDArray:
    """16-bit colours (height, width, 3 or 4), blue first, as OpenCV reads them."""
    # Pillow has already loaded the file and would have raised an error on damage; OpenCV only prints to standard error.
    deep = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if deep is None or deep.dtype != np.uint16 or deep.ndim != 3:
        raise ValueError("16-bit colours that cannot be decoded")
    return np.asarray(deep)


@contextmanager
def _by_rasterio(path: Path, driver: str, tags: dict[int, Any]) -> Iterator[_Picture]:
    import rasterio
    from rasterio.enums import ColorInterp
    from rasterio.windows import Window

    files = raster_files(path, PICTURE_DRIVERS, "image")
    # By default GDAL's cache takes 5 % of the machine's memory.
    with rasterio.Env(GDAL_CACHEMAX=_CACHE_MB), opened_raster(files, "image") as raster:
        colours = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
        kinds = list(raster.colorinterp)
        is_colour = all(colour in kinds for colour in colours)
        indexes = [kinds.index(colour) + 1 for colour in colours] if is_colour else [1]
        width, height = raster.width, raster.height
        # OpenJPEG decodes whole tiles at 4 bytes per pixel, and the whole image may be one tile.
        _check_size(path, width, height, 4 if driver == "JP2OpenJPEG" else 1)
        block_rows = raster.block_shapes[0][0]
        n_rows = max(_STRIP_PIXELS // width, 1)
        rows = max(n_rows // block_rows, 1) * block_rows

        def strips() -> Iterator[NDArray]:
            for top in range(0, height, rows):
                bands = raster.read(indexes, window=Window(0, top, width, min(rows, height - top)))
                for start in range(0, bands.shape[1], n_rows):
                    yield bands[:, start : start + n_rows]

        yield _Picture(
            path,
            width,
            height,
            tiff_orientation(tags),
            False,
            tags.get(_PHOTOMETRIC_TAG) == _WHITE_IS_ZERO,
            None if raster.nodata is None else float(raster.nodata),
            strips,
        )


def _check_size(path: Path, width: int, height: int, bytes_per_pixel: int) -> None:
    limit = min(MAX_PIXELS, MAX_DECODED // bytes_per_pixel)
    if width * height > limit:
        expected = f"at most {limit} pixels, for {bytes_per_pixel} bytes each"
        raise UserError(path, "size", f"{width} x {height}", expected)


def _nodata(tags: dict[int, Any]) -> float | None:
    try:
        return float(str(tags.get(_NODATA_TAG)).strip("\0 "))
    except ValueError:
        return None
