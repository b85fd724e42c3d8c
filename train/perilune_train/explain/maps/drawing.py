"""Sheets of attention masks with their images."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_train.explain.correlation.pearson import is_constant
from perilune_train.explain.maps.masks import Masks
from perilune_train.records.pictures import save_image

_CELL_PX = 160
_MAX_COLUMNS = 8
_WHITE = (255, 255, 255)


def draw_masks(path: Path, images: NDArray[np.uint8], masks: Masks, height_m: Sequence[float]) -> None:
    """Draw a PNG sheet of images (N, height, width), each followed by its masks, and one colour bar.

    `height_m` is the height of each image's camera, metres; it is written below the image. All masks share one colour
    scale, from the smallest to the largest value. The range of each mask, or "constant", is written below the mask.
    """
    low = min(float(gate_masks.min()) for gate_masks in masks.values())
    high = max(float(gate_masks.max()) for gate_masks in masks.values())
    columns = min(_MAX_COLUMNS, 1 + len(masks))
    sheet = []
    for n, image in enumerate(images):
        height = round(_CELL_PX * image.shape[0] / image.shape[1])
        grey = np.clip(image / max(1.0, float(np.percentile(image, 99.5))) * 255, 0, 255).astype(np.uint8)
        frame = cv2.cvtColor(cv2.resize(grey, (_CELL_PX, height), interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
        cells = [_labelled(frame, f"{height_m[n]:.0f} m high")]
        for name, gate_masks in masks.items():
            mask = cv2.resize(gate_masks[n], (_CELL_PX, height))
            cells.append(_labelled(_coloured(mask, low, high), caption(name, gate_masks[n])))
        cells += [np.full_like(cells[0], 255)] * (-len(cells) % columns)
        sheet += [np.hstack(cells[i : i + columns]) for i in range(0, len(cells), columns)]
    sheet.append(_colour_bar(sheet[0].shape[1], low, high))
    save_image(path, np.vstack(sheet))


def caption(block: str, mask: NDArray[np.floating]) -> str:
    """A gate's name with the range of its mask, or with "constant" and the value if the mask does not vary."""
    span = f"constant {mask.mean():.3f}" if is_constant(mask) else f"{mask.min():.3f}-{mask.max():.3f}"
    return f"{block} {span}"


def _coloured(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint8]:
    """Colours (height, width, 3), BGR, of values (height, width) on the scale from `low` to `high`."""
    level = np.clip(255 * (values - low) / max(high - low, 1e-9), 0, 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS), np.uint8)


def _colour_bar(width_px: int, low: float, high: float) -> NDArray[np.uint8]:
    """Colour bar of the scale from `low` to `high`, with five values below it."""
    margin = 40
    bar = np.tile(np.linspace(low, high, width_px - 2 * margin), (16, 1))
    picture = cv2.copyMakeBorder(_coloured(bar, low, high), 10, 24, margin, margin, cv2.BORDER_CONSTANT, value=_WHITE)
    for value in np.linspace(low, high, 5):
        x = margin + (value - low) / max(high - low, 1e-9) * (width_px - 2 * margin)
        cv2.putText(
            picture, f"{value:.2f}", (int(x) - 16, 44), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA
        )
    cv2.putText(picture, "gate", (2, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


def _labelled(picture: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """The picture with a line of text below and a white margin."""
    framed = cv2.copyMakeBorder(picture, 2, 18, 2, 2, cv2.BORDER_CONSTANT, value=_WHITE)
    cv2.putText(framed, text, (4, framed.shape[0] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return framed
