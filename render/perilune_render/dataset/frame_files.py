"""Write the files of a frame: the PNG, and optionally the EXR and the flash lidar image."""

import hashlib

import cv2
import numpy as np

from perilune_render.engines.frame_source import Frame, FrameSource
from perilune_render.imaging.exr import exr_bytes
from perilune_render.outputs.of_scene import FrameOutputs
from perilune_shared.dataset.names import ImageKind, SceneFileKind, frame_path
from perilune_shared.storage.store import Address, open_store

NO_OUTPUTS = FrameOutputs()


def write_frame(
    out: Address, frame_id: str, source: FrameSource, frame: Frame, *, exr: bool, outputs: FrameOutputs = NO_OUTPUTS
) -> dict[str, str | int]:
    """Write a frame's PNG, the EXR if `exr` is true, and the flash lidar image if there is one.

    Returns the columns png_*, exr_* and lidar_* of the manifest. Does not wait until the files are on disk.
    """
    store, columns = open_store(out), dict[str, str | int]()
    for kind, content in frame_contents(source, frame, exr=exr, outputs=outputs).items():
        path = frame_path(frame_id, kind)
        store.replace(path, content, durable=False)
        columns |= file_columns(kind, path, content)
    return columns


def frame_contents(
    source: FrameSource, frame: Frame, *, exr: bool, outputs: FrameOutputs = NO_OUTPUTS
) -> dict[ImageKind, bytes]:
    """The contents of the files that `write_frame` writes."""
    contents: dict[ImageKind, bytes] = {"png": png_bytes(frame.image, source.sensor.bits)}
    if exr:
        contents["exr"] = exr_bytes(frame.radiance, source.crater_index(frame), outputs.channels)
    if outputs.lidar is not None:
        contents["lidar"] = outputs.lidar
    return contents


def png_bytes(image: np.ndarray, bits: int) -> bytes:
    """Encode an image (h, w), DN, as PNG.

    With more than 8 bits, the PNG has 16 bits: the grey values use the upper bits, and the lower bits are 0.
    """
    stored = image if bits == 8 else image << (16 - bits)
    return cv2.imencode(".png", stored)[1].tobytes()


def file_columns(kind: ImageKind | SceneFileKind, path: str, content: bytes) -> dict[str, str | int]:
    """The manifest columns of a file: <kind>_path, <kind>_bytes and <kind>_sha256."""
    return {
        f"{kind}_path": path,
        f"{kind}_bytes": len(content),
        f"{kind}_sha256": hashlib.sha256(content).hexdigest(),
    }
