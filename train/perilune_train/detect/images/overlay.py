"""Draw detections over an image as ellipses coloured by score, with a colour scale and a count below."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.evaluate.matching import Detections
from perilune_train.records.pictures import save_image

MAX_DRAWN = 1000
"""Maximum number of craters drawn in an overlay; more lines would hide the ground."""
_MAX_PX = 4096
_MIN_PX = 1600
_LINE_OPACITY = 0.8
"""Opacity of the lines, so that the ground shows through. Lines are one pixel wide, OpenCV's minimum."""
_DARKEST = 80
"""First entry used of the 256 entries of the colour map. Darker entries are invisible on grey."""
_STRIP_FRACTION = 0.02
"""Height of the strip below the image, as a fraction of the image's longer side."""


def write_overlay(path: Path, image: NDArray[np.uint8], detections: Detections, threshold: float) -> None:
    """Draw detections as ellipses over an image; enlarges small images and reduces large images.

    Colours go from purple (the threshold) to yellow (a score of 1). Draws at most MAX_DRAWN detections, those with the
    highest scores. The strip below the image states the number of all detections.
    """
    side = max(image.shape)
    factor = min(max(_MIN_PX // side, 1), 4) if side < _MAX_PX else _MAX_PX / side
    size = tuple(max(round(length * factor), 1) for length in image.shape[::-1])
    interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    canvas = cv2.cvtColor(cv2.resize(image, size, interpolation=interpolation), cv2.COLOR_GRAY2BGR)
    # Draw the highest scores last, on top of the others.
    drawn = np.argsort(detections.scores, kind="stable")[-MAX_DRAWN:]
    lines = canvas.copy()
    for k, colour in zip(drawn, _colours(detections.scores[drawn], threshold), strict=True):
        draw_ellipses(lines, detections.ellipses[k : k + 1] * [factor, factor, factor, factor, 1], colour)
    canvas = cv2.addWeighted(lines, _LINE_OPACITY, canvas, 1 - _LINE_OPACITY, 0)
    count = f"{len(detections.scores)} craters"
    if len(drawn) < len(detections.scores):
        count += f", drawn: the {len(drawn)} with the highest scores"
    save_image(path, np.vstack([canvas, _strip(canvas.shape[1], max(size), threshold, count)]))


def draw_boxes(canvas: NDArray[np.uint8], boxes: NDArray[np.float64], colour: tuple[int, int, int]) -> None:
    """Draw the axis-aligned ellipses in boxes (M, 4) onto an image (height, width, 3): blue, green, red."""
    half = (boxes[:, 2:] - boxes[:, :2]) / 2
    draw_ellipses(canvas, np.column_stack([(boxes[:, :2] + boxes[:, 2:]) / 2, half, np.zeros(len(boxes))]), colour)


def draw_ellipses(canvas: NDArray[np.uint8], ellipses: NDArray[np.float64], colour: tuple[int, int, int]) -> None:
    """Draw ellipses (M, 5) onto an image (height, width, 3): blue, green, red.

    An ellipse is its centre x, y, semi-axes a and b in pixels, and the direction of a in radians.
    """
    # OpenCV takes integers, here sixteenths of a pixel, and counts from the centre of the first pixel.
    sixteenths = np.rint(16 * (ellipses[:, :4] - [0.5, 0.5, 0, 0])).astype(int)
    for (x, y, a, b), angle_deg in zip(sixteenths.tolist(), np.degrees(ellipses[:, 4]).tolist(), strict=True):
        cv2.ellipse(canvas, (x, y), (a, b), angle_deg, 0, 360, colour, 1, cv2.LINE_AA, 4)


def _colours(scores: NDArray[np.float64], threshold: float) -> list[tuple[int, int, int]]:
    """Colours of scores between the threshold and 1, in OpenCV's order blue, green, red."""
    fraction = np.clip((scores - threshold) / max(1 - threshold, 1e-9), 0, 1)
    levels = np.rint(_DARKEST + fraction * (255 - _DARKEST)).astype(np.uint8)
    if not len(levels):
        return []
    return [(int(b), int(g), int(r)) for b, g, r in cv2.applyColorMap(levels[:, None], cv2.COLORMAP_PLASMA)[:, 0]]


def _strip(width_px: int, side_px: int, threshold: float, count: str) -> NDArray[np.uint8]:
    """A black strip (height, width, 3) with colour scale and text, cut off if the image is narrow."""
    height = max(round(_STRIP_FRACTION * side_px), 24)
    strip = np.zeros((height, max(width_px, 1), 3), np.uint8)
    scale, margin = height / 48, height // 4
    base = height - height // 3

    def write(text: str, x_px: int) -> int:
        cv2.putText(strip, text, (x_px, base), cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1, cv2.LINE_AA)
        return x_px + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] + margin

    x = write(f"score {threshold:.2f}", margin)
    bar = np.array(_colours(np.linspace(threshold, 1, 4 * height), threshold), np.uint8)[None]
    bar = bar[:, : max(strip.shape[1] - x, 0)]
    strip[margin : height - margin, x : x + bar.shape[1]] = bar
    write(count, write("1", x + 4 * height + margin) + margin)
    return strip
