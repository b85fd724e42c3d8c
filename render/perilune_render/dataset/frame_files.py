"""Write a frame's files: PNG, and EXR on request."""

import hashlib

import cv2
import numpy as np

from perilune_render.frame_source import Frame, FrameSource
from perilune_render.imaging.exr import exr_bytes
from perilune_shared.dataset.names import ImageKind, frame_path
from perilune_shared.storage.store import Address, Store, open_store


def write_frame(out: Address, frame_id: str, source: FrameSource, frame: Frame, *, exr: bool) -> dict[str, str | int]:
    """Write a frame's PNG, and with `exr` its EXR; returns its columns png_* and exr_* of the manifest.

    Does not wait until the files are on the disk.
    """
    store, columns = open_store(out), dict[str, str | int]()
    for kind, content in frame_contents(source, frame, exr=exr).items():
        columns |= _write(store, frame_id, kind, content)
    return columns


def frame_contents(source: FrameSource, frame: Frame, *, exr: bool) -> dict[ImageKind, bytes]:
    """The content of a frame's PNG, and with `exr` of its EXR."""
    contents: dict[ImageKind, bytes] = {"png": png_bytes(frame.image, source.sensor.bits)}
    if exr:
        contents["exr"] = exr_bytes(frame.radiance, source.crater_index(frame))
    return contents


def png_bytes(image: np.ndarray, bits: int) -> bytes:
    """An image (h, w), DN, as PNG. Above 8 bits the PNG has 16: a grey value fills the upper bits, the lower are 0."""
    stored = image if bits == 8 else image << (16 - bits)
    return cv2.imencode(".png", stored)[1].tobytes()


def _write(store: Store, frame_id: str, kind: ImageKind, content: bytes) -> dict[str, str | int]:
    """Write a file of a frame; returns its columns png_* or exr_* (by `kind`)."""
    path = frame_path(frame_id, kind)
    store.replace(path, content, durable=False)
    return {
        f"{kind}_path": path,
        f"{kind}_bytes": len(content),
        f"{kind}_sha256": hashlib.sha256(content).hexdigest(),
    }
