"""Unpack videos, and TIFF files of several pages, into pictures in a folder. Both are untrusted input."""

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2
from PIL import Image

from perilune_shared.console.terminal import say
from perilune_shared.errors import UserError
from perilune_train.detect.images.read import MAX_PIXELS

VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm")
_MAX_PIXELS = 2**32
"""Maximum number of pixels of all frames: 2000 frames of 1920 x 1080, or 65,000 frames of 256 x 256."""
_MAX_PAGES, _NEW_SUBFILE_TYPE = 65_536, 254
_STARTS = ((4, b"ftyp"), (4, b"moov"), (4, b"mdat"), (4, b"wide"), (0, b"RIFF"), (0, b"\x1aE\xdf\xa3"))
"""First bytes of MP4, QuickTime, AVI and Matroska files. Other files are refused, because FFmpeg would also read lists
of other files and of network addresses."""


def frames_of(path: Path, folder: Path) -> list[Path] | None:
    """Write the frames of a video, or the pages of a TIFF, into a folder, and return their paths.

    The files are named <file name>.<index>.png (.tif for pages). Returns None if the file is a single picture. Raises
    UserError if OpenCV cannot decode a video, or if all frames together have more than _MAX_PIXELS.
    """
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return _of_video(path, folder)
    pages = _pages(path) if path.suffix.lower() in (".tif", ".tiff") else []
    return None if len(pages) < 2 else _of_tiff(path, pages, folder)


def _of_video(path: Path, folder: Path) -> list[Path]:
    expected = f"an MP4, AVI or Matroska video that OpenCV decodes, or its frames: ffmpeg -i {path.name} %06d.png"
    try:
        with path.open("rb") as stream:
            start = stream.read(12)
    except OSError as error:
        raise UserError(path, "video", error.strerror or "no such file", expected) from None
    if not any(start[offset:].startswith(text) for offset, text in _STARTS):
        raise UserError(path, "video", "another kind of file", expected)
    # Silence FFmpeg: it prints messages of several lines.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        width, height = (int(capture.get(each)) for each in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not capture.isOpened() or width <= 0 or height <= 0:
            raise UserError(path, "video", "no frame that OpenCV can decode", expected)
        if width * height > MAX_PIXELS:
            raise UserError(path, "size", f"{width} x {height} pixels", f"at most {MAX_PIXELS} pixels")
        paths: list[Path] = []
        while (decoded := capture.read())[0]:
            _check_total(path, (len(paths) + 1) * width * height)
            paths.append(folder / f"{path.name}.{len(paths):06d}.png")
            cv2.imwrite(str(paths[-1]), decoded[1], (cv2.IMWRITE_PNG_COMPRESSION, 1))
    finally:
        capture.release()
    if not paths:
        raise UserError(path, "video", "no frame that OpenCV can decode", expected)
    say(f"{path.name}: {len(paths)} frames")
    return paths


def _pages(path: Path) -> list[int]:
    """Numbers of the pages of a TIFF that are separate pictures.

    If the file cannot be read, the list ends before the damage; `read_grey` later reports the error.
    """
    pages: list[int] = []
    with contextlib.suppress(OSError, ValueError, SyntaxError, EOFError), _opened(path) as image:
        for number in range(_MAX_PAGES):
            image.seek(number)
            # Bit 0 marks a smaller copy of another page, such as a GeoTIFF overview; bit 2 marks a mask.
            if not int(image.tag_v2.get(_NEW_SUBFILE_TYPE, 0)) & 0b101:  # type: ignore[attr-defined]
                pages.append(number)
    return pages


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """Open a TIFF without Pillow's own limit on its size: this file and `read_grey` check sizes."""
    with warnings.catch_warnings():
        # Serious errors raise an exception; warnings concern metadata only.
        warnings.simplefilter("ignore")
        Image.MAX_IMAGE_PIXELS = None
        with Image.open(path, formats=("TIFF",)) as image:
            yield image


def _of_tiff(path: Path, pages: list[int], folder: Path) -> list[Path]:
    paths, pixels = [], 0
    with _opened(path) as image:
        for number, page in enumerate(pages):
            try:
                image.seek(page)
                pixels += image.width * image.height
                _check_total(path, pixels)
                if image.width * image.height > MAX_PIXELS:
                    got = f"{image.width} x {image.height}"
                    raise UserError(path, f"page {page}", got, f"at most {MAX_PIXELS} pixels")
                paths.append(folder / f"{path.name}.{number:06d}.tif")
                image.save(paths[-1])
            except (OSError, SyntaxError, ValueError) as error:
                raise UserError(path, f"page {page}", error, "a page that Pillow decodes") from None
    say(f"{path.name}: {len(paths)} pages")
    return paths


def _check_total(path: Path, pixels: int) -> None:
    if pixels > _MAX_PIXELS:
        expected = f"at most {_MAX_PIXELS}; take fewer frames: ffmpeg -i {path.name} -vf fps=1 %06d.png"
        raise UserError(path, "pixels of all frames", f"more than {_MAX_PIXELS}", expected)
