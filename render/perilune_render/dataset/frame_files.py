"""Write a frame's files: PNG, and EXR on request."""

from pathlib import Path

import cv2
import numpy as np

from perilune_render.frame_source import Frame, FrameSource
from perilune_render.imaging.exr import write_exr
from perilune_shared.dataset.names import ImageKind, frame_path
from perilune_shared.storage import files


def write_frame(root: Path, frame_id: str, source: FrameSource, frame: Frame, *, exr: bool) -> dict[str, str | int]:
    """Write a frame's PNG, and with `exr` its EXR; returns its columns png_* and exr_* of the manifest.

    Does not wait until the files are on the disk.
    """
    write_png(files.inside(root, frame_path(frame_id, "png")), frame.image, source.sensor.bits)
    columns = _columns(root, frame_id, "png")
    if exr:
        write_exr(root / frame_path(frame_id, "exr"), frame.radiance, source.crater_index(frame))
        columns |= _columns(root, frame_id, "exr")
    return columns


def write_png(path: Path, image: np.ndarray, bits: int) -> None:
    """Write an image (h, w), DN. Above 8 bits the PNG has 16: a grey value fills the upper bits, the lower ones are 0.

    Does not wait until the file is on the disk.
    """
    stored = image if bits == 8 else image << (16 - bits)
    files.write_bytes(path, cv2.imencode(".png", stored)[1].tobytes(), durable=False)


def _columns(root: Path, frame_id: str, kind: ImageKind) -> dict[str, str | int]:
    """The columns png_* or exr_* (by `kind`) of a written file."""
    path = frame_path(frame_id, kind)
    whole = root / path
    return {
        f"{kind}_path": path,
        f"{kind}_bytes": whole.stat().st_size,
        f"{kind}_sha256": files.sha256_of(whole),
    }
