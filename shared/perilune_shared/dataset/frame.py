"""One frame of a dataset: its row, its image and its labels."""

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.dataset.metadata import LARGEST_IMAGE_PX
from perilune_shared.errors import UserError, one_line
from perilune_shared.pictures import GREEN, display, with_ellipses
from perilune_shared.storage.png import png_header

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

ELLIPSE_COLUMNS = ["ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px", "ellipse_theta_rad"]
"""Columns of the table `labels` that describe an ellipse."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame, as returned by `dataset[i]`."""

    row: dict[str, Any]
    """The frame's row in the table `frames`: pose, time, split, ...; column names contain the units."""
    labels: pd.DataFrame
    """The frame's rows in the table `labels`, one per crater."""
    png: bytes
    """Content of the PNG file."""

    @property
    def frame_id(self) -> str:
        """Key of the frame in all tables: scene_id/trajectory_id/frame_index."""
        return str(self.row["frame_id"])

    @property
    def image(self) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Grey values (height, width), 8 or 16 bits.

        Raises UserError if the file is not a grey PNG of 8 or 16 bits, or if its size differs from the manifest.
        """
        from PIL import Image

        # Decoders accept a PNG whose last bytes are missing, so check the file size.
        size_bytes = self.row["png_bytes"]
        if pd.notna(size_bytes) and len(self.png) != size_bytes:
            expected = f"{int(size_bytes)} bytes; see `perilune-manifest validate`, and render the damaged frame again"
            raise UserError(self.frame_id, "png_bytes", f"{len(self.png)} bytes", expected)
        try:
            header = png_header(self.png)
            if header.width_px * header.height_px > LARGEST_IMAGE_PX:
                raise ValueError(f"{header.width_px} x {header.height_px} pixels")
            with Image.open(io.BytesIO(self.png), formats=["PNG"]) as picture:
                if header.bits == 8:
                    return np.asarray(picture).astype(np.uint8, copy=False)
                return np.asarray(picture).astype(np.uint16)
        except (ValueError, OSError, SyntaxError) as error:
            raise UserError(
                self.frame_id, "image", error, f"a grey PNG of 8 or 16 bits, at most {LARGEST_IMAGE_PX} pixels"
            ) from None

    def plot(self) -> "Picture":
        """Return a picture of the frame with the ellipses of all labels. Raises UserError as `image` does."""
        return with_ellipses(self.image, self.labels[ELLIPSE_COLUMNS].to_numpy(), [GREEN] * len(self.labels))

    def show(self) -> None:
        """Show the picture of `plot` in the notebook, or in the system's viewer."""
        display(self.plot())

    def __repr__(self) -> str:
        split, time_s, altitude_m = self.row["split"], self.row["time_s"], self.row["position_m"][2]
        summary = f"{split}, time {time_s:.1f} s, {altitude_m:.0f} m above the site, {len(self.labels)} labels"
        return one_line(f"Frame({self.frame_id}: {summary})")
