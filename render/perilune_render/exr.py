"""EXR files: what Blender writes, and what the dataset holds."""

import errno
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR

from perilune_shared.errors import UserError
from perilune_shared.files import written_aside

CHANNELS = ("R", "Z", "N.X", "N.Y", "N.Z", "sunlit", "crater")


@dataclass(frozen=True, slots=True)
class Radiance:
    """What a renderer gives for one frame, before the sensor."""

    radiance_factor: np.ndarray
    """I/F (h, w) float32."""
    depth_m: np.ndarray
    """Along the camera's axis, of the ray through the pixel's centre, metres; infinite where it hits nothing (h, w)
    float32."""
    normal: np.ndarray
    """Unit shading normal in O_L, 0 where nothing is hit; where EXRs are asked for that of the same ray, else the mean
    direction over the pixel's samples (h, w, 3) float32."""
    sunlit: np.ndarray
    """Whether the Sun reaches the pixel (h, w) bool."""


def write_exr(path: Path, radiance: Radiance, crater: np.ndarray) -> None:
    """Write a frame: float32 channels CHANNELS (h, w; sunlit 0 or 1, crater -1 for none), losslessly compressed."""
    values = (radiance.radiance_factor, radiance.depth_m, *np.moveaxis(radiance.normal, -1, 0), radiance.sunlit, crater)
    channels = {name: np.ascontiguousarray(value, np.float32) for name, value in zip(CHANNELS, values, strict=True)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with written_aside(path) as aside:
        try:
            OpenEXR.File(header, channels).write(str(aside))
        except RuntimeError as error:
            raise OSError(errno.ENOSPC, f"cannot write ({error})", str(path)) from None


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """Channels (h, w) by name. Raises UserError where the file is missing or damaged."""
    if not path.is_file():
        raise UserError(path, "exr", "no such file", "an EXR frame")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as image:
            return {name: channel.pixels for name, channel in image.channels().items()}
    except (RuntimeError, ValueError) as error:
        raise UserError(path, "exr", error, "a whole EXR file") from None


def read_radiance(path: Path) -> Radiance:
    """A frame as it was before the sensor. Raises UserError where the file is missing, damaged or lacks a channel."""
    channels = read_exr(path)
    missing = [name for name in CHANNELS if name not in channels]
    if missing:
        raise UserError(path, "channels", f"no {missing[0]}", ", ".join(CHANNELS))
    normal = np.stack([channels[name] for name in ("N.X", "N.Y", "N.Z")], axis=-1)
    return Radiance(channels["R"], channels["Z"], normal, channels["sunlit"] > 0.5)
