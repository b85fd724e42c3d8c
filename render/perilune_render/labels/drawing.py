"""Contact sheets: frames side by side, with labels drawn on them."""

from pathlib import Path

import cv2
import numpy as np

from perilune_render.labels.frame_labels import Labels
from perilune_shared.storage.files import write_bytes

_CHOSEN, _OTHER = (80, 220, 80), (60, 140, 255)
"""Colours of the ellipses, BGR."""
_DARK = 40


def draw_labels(image: np.ndarray, labels: Labels, chosen: np.ndarray, scale: int = 2) -> np.ndarray:
    """The image in colour, enlarged (scale h, scale w, 3), with the ellipses of N labels.

    The ellipses of labels with a true value in `chosen` (N,) are green, all others are orange.
    """
    picture = cv2.cvtColor(enlarge(image, scale), cv2.COLOR_GRAY2BGR)
    e = labels.ellipses
    for k in range(len(labels.crater_id)):
        box = (
            (e.cx_px[k] * scale, e.cy_px[k] * scale),
            (2 * e.a_px[k] * scale, 2 * e.b_px[k] * scale),
            np.degrees(e.theta_rad[k]),
        )
        cv2.ellipse(picture, box, _CHOSEN if chosen[k] else _OTHER, 1, cv2.LINE_AA)
    return picture


def enlarge(image: np.ndarray, scale: int) -> np.ndarray:
    """Enlarge an image: each pixel becomes a square with a side of `scale` pixels."""
    return np.repeat(np.repeat(image, scale, axis=0), scale, axis=1)


def padded(pictures: list[np.ndarray], group_sizes: list[int], columns: int) -> list[np.ndarray]:
    """Pictures padded to one size for a sheet; each group of `group_sizes[k]` pictures starts a new row.

    `columns` is the number of pictures in a row. Added pixels and added pictures are dark grey.
    """
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    sheet, rest = [], iter(pictures)
    for n in group_sizes:
        row = [next(rest) for _ in range(n)] + [np.full((1, 1), _DARK, np.uint8)] * (-n % columns)
        for picture in row:
            more = (0, height - picture.shape[0], 0, width - picture.shape[1])
            sheet.append(cv2.copyMakeBorder(picture, *more, cv2.BORDER_CONSTANT, value=(_DARK,) * 3))
    return sheet


def write_sheet(path: Path, pictures: list[np.ndarray], columns: int) -> None:
    """Write pictures of one size, grey or colour, row by row with a thin gap, as one PNG."""
    write_bytes(path, sheet_png(pictures, columns))


def sheet_png(pictures: list[np.ndarray], columns: int) -> bytes:
    """Pictures of one size, grey or colour, row by row with a thin gap, as the bytes of a PNG."""
    colour = [p if p.ndim == 3 else cv2.cvtColor(p, cv2.COLOR_GRAY2BGR) for p in pictures]
    padded = [cv2.copyMakeBorder(p, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(40, 40, 40)) for p in colour]
    while len(padded) % columns:
        padded.append(np.full_like(padded[0], 40))
    rows = [np.hstack(padded[i : i + columns]) for i in range(0, len(padded), columns)]
    return cv2.imencode(".png", np.vstack(rows))[1].tobytes()
