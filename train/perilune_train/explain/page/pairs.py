"""Before-and-after pictures of removed pixels."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_train.explain.evidence.removal import CONTROLS, chosen_pixels, random_like, removed, shifted_like
from perilune_train.records.pictures import save_image

_CELL_PX = 256
_CAPTION_PX = 20


def draw_removed(
    path: Path, image: NDArray[np.uint8], map_: NDArray[np.floating], sign: int, share: float, seed: int
) -> None:
    """Draw a PNG row: the image (height, width), its map, and the image with the most attended, random, shifted and
    least attended pixels inpainted.
    """
    rng = np.random.default_rng(seed)
    most, least = (chosen_pixels(map_, share, which, sign, rng) for which in ("most", "least"))
    choices = {
        "most attended": most,
        CONTROLS[0]: random_like(image, most, rng),
        CONTROLS[1]: shifted_like(most, rng),
        "least attended": least,
    }
    low, high = float(map_.min()), float(map_.max())
    level = (255 * (map_ - low) / max(high - low, 1e-9)).astype(np.uint8)
    cells = {"before": cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), "mask": cv2.applyColorMap(level, cv2.COLORMAP_CIVIDIS)}
    for name, chosen in choices.items():
        cells[name] = cv2.cvtColor(removed(image, chosen, "inpaint"), cv2.COLOR_GRAY2BGR)
    save_image(path, np.hstack([_captioned(np.asarray(cell, np.uint8), name) for name, cell in cells.items()]))


def _captioned(cell: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    size = _CELL_PX, round(_CELL_PX * cell.shape[0] / cell.shape[1])
    framed = cv2.copyMakeBorder(
        cv2.resize(cell, size), 2, _CAPTION_PX, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255)
    )
    where = 4, framed.shape[0] - 5
    cv2.putText(framed, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.asarray(framed, np.uint8)
