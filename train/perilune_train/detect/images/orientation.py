"""Orientation of a picture: the EXIF or TIFF tag 274 states how to turn the stored picture upright.

The tag is applied in all formats, so pixels, labels and detections refer to the upright picture, which every viewer
shows. Without it, the pixels of a rotated photograph would not match labels drawn on the upright picture.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

UPRIGHT = 1
ORIENTATION_TAG = 274
_MIRRORED, _HALF_TURNED, _TRANSPOSED = (2, 3, 6, 7), (3, 4, 7, 8), (5, 6, 7, 8)
"""Orientations that reverse the columns, that reverse the rows, and that first exchange rows and columns."""
_MAX_EXIF = 2**20
_BIG_TIFF = (b"II\x2b\x00", b"MM\x00\x2b")


def is_turned(orientation: int) -> bool:
    """Whether the orientation exchanges width and height."""
    return orientation in _TRANSPOSED


def upright(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Turn stored pixels (height, width) upright; returns the input if they are upright already."""
    if orientation == UPRIGHT:
        return pixels
    turned = pixels.T if is_turned(orientation) else pixels
    rows, columns = (slice(None, None, -1 if orientation in kind else 1) for kind in (_HALF_TURNED, _MIRRORED))
    return np.ascontiguousarray(turned[rows, columns])


def stored_coordinates(orientation: int, width_px: int, height_px: int) -> NDArray[np.float64]:
    """Matrix (2, 3) that converts pixel coordinates of the upright picture to the stored picture.

    `width_px` and `height_px` are the size of the stored picture. Coordinates begin at the outer corner of the top-left
    pixel.
    """
    right, down = (height_px, width_px) if is_turned(orientation) else (width_px, height_px)
    x = [-1.0, 0.0, right] if orientation in _MIRRORED else [1.0, 0.0, 0.0]
    y = [0.0, -1.0, down] if orientation in _HALF_TURNED else [0.0, 1.0, 0.0]
    return np.array([y, x] if is_turned(orientation) else [x, y])


def orientation_of(picture: Any, path: Path) -> int:
    """The orientation of a PNG or JPEG that Pillow has opened; 1 without a valid tag. Reads no pixels."""
    try:
        # PngImageFile.getexif would decode the whole picture to find an eXIf chunk after the pixels.
        exif = Image.Image.getexif(picture)
        if not len(exif) and picture.format == "PNG":
            exif.load(_late_exif(path))
        return _valid(exif.get(ORIENTATION_TAG))
    except (OSError, ValueError, SyntaxError, TypeError, KeyError, AttributeError):
        # Pillow shows a picture with damaged EXIF as it is stored.
        return UPRIGHT


def tiff_tags(path: Path) -> dict[int, Any]:
    """The tags of a TIFF's first picture; {} if the tags are damaged.

    Works even if Pillow cannot open the picture.
    """
    try:
        with path.open("rb") as file:
            header = file.read(8)
            if header[:4] in _BIG_TIFF:
                header += file.read(8)
            tags = ImageFileDirectory_v2(header)
            file.seek(tags.next)
            tags.load(file)
            return dict(tags)
    except (OSError, ValueError, SyntaxError, TypeError, KeyError, IndexError, OverflowError, MemoryError):
        return {}


def tiff_orientation(tags: dict[int, Any]) -> int:
    """The orientation that a TIFF's tags give; 1 without a valid tag."""
    return _valid(tags.get(ORIENTATION_TAG))


def _valid(value: Any) -> int:
    number = value[0] if isinstance(value, tuple) and value else value
    return int(number) if isinstance(number, int | float) and number in range(1, 9) else UPRIGHT


def _late_exif(path: Path) -> bytes:
    """The eXIf chunk of a PNG, at any position; empty if there is none."""
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8:
            length = int.from_bytes(head[:4], "big")
            if head[4:] == b"eXIf" and length <= _MAX_EXIF:
                return b"Exif\0\0" + file.read(length)
            file.seek(length + 4, io.SEEK_CUR)
    return b""
