"""One frame of a dataset: its row, its image and its labels."""

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.storage.png import png_header

_MOST_PIXELS = 2**27


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame as `dataset[i]` gives it."""

    row: dict[str, Any]
    """Columns of the table frames: pose, time, split, ... with their units in the names."""
    labels: pd.DataFrame
    """Its rows of the table labels, one crater a row."""
    png: bytes
    """The image file."""

    @property
    def frame_id(self) -> str:
        """The key in every table: scene, trajectory and number."""
        return str(self.row["frame_id"])

    @property
    def image(self) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Grey levels (height, width), 8 or 16 bits. Raises UserError where the file is not such a PNG."""
        from PIL import Image

        try:
            header = png_header(self.png)
            if header.width_px * header.height_px > _MOST_PIXELS:
                raise ValueError(f"{header.width_px} x {header.height_px} pixels")
            with Image.open(io.BytesIO(self.png), formats=["PNG"]) as picture:
                if header.bits == 8:
                    return np.asarray(picture).astype(np.uint8, copy=False)
                return np.asarray(picture).astype(np.uint16)
        except (ValueError, OSError, SyntaxError) as error:
            raise UserError(
                self.frame_id, "image", error, f"a grey PNG of 8 or 16 bits, at most {_MOST_PIXELS} pixels"
            ) from None
