"""Read the EXR files that Blender writes; create and read the EXR files of datasets."""

import contextlib
import io
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import OpenEXR

from perilune_render.imaging.radiance import Radiance
from perilune_shared.dataset.manifest import LARGEST_FRAME_BYTES
from perilune_shared.dataset.metadata import LARGEST_IMAGE_PX
from perilune_shared.errors import UserError
from perilune_shared.storage import files
from perilune_shared.storage.store import Store

_MAX_CHANNELS = 64
CHANNELS = ("R", "Z", "N.X", "N.Y", "N.Z", "sunlit", "crater")


def exr_bytes(radiance: Radiance, crater: np.ndarray, more: Mapping[str, np.ndarray] | None = None) -> bytes:
    """The content of a frame's EXR file: CHANNELS and the channels in `more`, (h, w) float32.

    The channel `sunlit` is 0 or 1; the channel `crater` is a crater id, or -1 without a crater.
    """
    values = (radiance.radiance_factor, radiance.depth_m, *np.moveaxis(radiance.normal, -1, 0), radiance.sunlit, crater)
    return channel_bytes(dict(zip(CHANNELS, values, strict=True)) | dict(more or {}))


def channel_bytes(channels: Mapping[str, np.ndarray]) -> bytes:
    """The content of an EXR file with named channels (h, w), stored as float32 with lossless compression."""
    stored = {name: np.ascontiguousarray(value, np.float32) for name, value in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    OpenEXR.File(header, stored).write(stream)
    return stream.getvalue()


@contextlib.contextmanager
def local_exr(store: Store, path: str) -> Iterator[Path]:
    """Yield a local path of a dataset's EXR.

    OpenEXR reads only local files, so an EXR in a remote store is first copied into a temporary file.
    """
    if store.folder is not None:
        yield files.inside(store.folder, path)
        return
    with tempfile.NamedTemporaryFile(prefix="perilune-", suffix=".exr") as copy:
        copy.write(store.read(path, most_bytes=LARGEST_FRAME_BYTES))
        copy.flush()
        yield Path(copy.name)


def read_exr(path: Path, size_px: tuple[int, int] | None = None) -> dict[str, np.ndarray]:
    """Read the channels (h, w) of an EXR file, by name.

    Raises UserError if the file is missing, damaged or not of `size_px` (width, height). A small file may decompress to
    any size, so the header is checked before the pixels are read.
    """
    if not path.is_file():
        raise UserError(path, "exr", "no such file", "an EXR frame")
    try:
        with OpenEXR.File(str(path), header_only=True) as header:
            _check_header(path, header, size_px)
        with OpenEXR.File(str(path), separate_channels=True) as image:
            return {name: channel.pixels for name, channel in image.channels().items()}
    except (RuntimeError, ValueError, TypeError, MemoryError) as error:
        raise UserError(path, "exr", error, "a complete, undamaged EXR file") from None


def _check_header(path: Path, image: OpenEXR.File, size_px: tuple[int, int] | None) -> None:
    """Raise UserError for a wrong size, too many pixels or channels, or an unusual structure."""
    if len(image.parts) != 1:
        raise UserError(path, "parts", len(image.parts), "one")
    header = image.parts[0].header
    low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
    width, height = (high - low + 1).tolist()
    if width < 1 or height < 1 or width * height > LARGEST_IMAGE_PX:
        raise UserError(path, "size", f"{width} x {height} pixels", f"at most {LARGEST_IMAGE_PX} pixels")
    if size_px is not None and (width, height) != size_px:
        raise UserError(path, "size", f"{width} x {height} pixels", f"{size_px[0]} x {size_px[1]}")
    channels = header["channels"]
    if len(channels) > _MAX_CHANNELS:
        raise UserError(path, "channels", len(channels), f"at most {_MAX_CHANNELS}")
    if any((channel.xSampling, channel.ySampling) != (1, 1) for channel in channels):
        raise UserError(path, "channels", "fewer samples than pixels", "a value for each pixel")


def read_radiance(path: Path, size_px: tuple[int, int] | None = None) -> Radiance:
    """Read the rendering of a frame from its EXR; `size_px` is the expected width and height.

    Raises UserError if the file is missing, damaged, of another size or lacks a channel.
    """
    channels = read_exr(path, size_px)
    missing = [name for name in CHANNELS if name not in channels]
    if missing:
        raise UserError(path, "channels", f"no {missing[0]}", ", ".join(CHANNELS))
    normal = np.stack([channels[name] for name in ("N.X", "N.Y", "N.Z")], axis=-1)
    return Radiance(channels["R"], channels["Z"], normal, channels["sunlit"] > 0.5)
