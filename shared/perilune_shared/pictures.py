"""Draw ellipses onto images. The results are Pillow images, which notebooks display.

Example:

    with_ellipses(frame.image, ellipses).save("frame.png")
"""

import sys
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from PIL.Image import Image

GREEN, ORANGE, CYAN = (80, 220, 80), (255, 140, 60), (25, 211, 227)
"""Colours: selected labels, other labels, detections."""
_SMALLEST_PX, _LARGEST_PX = 1024, 4096
"""Limits of a picture's longer side, pixels.

An image is enlarged by the largest whole factor that keeps its longer side within the first limit. An image above the
second limit is reduced to it."""
_ANGLES = np.linspace(0, 2 * np.pi, 65)


def with_ellipses(image: NDArray, ellipses: ArrayLike, colours: list[tuple[int, int, int]] | None = None) -> "Image":
    """Draw ellipses (N, 5) onto a grey image (h, w) of 8 or 16 bits.

    A row of `ellipses` has centre x and y and semi-axes a and b, pixels, then the direction of a, radians, as in the
    table `labels`. `colours` has N colours (red, green, blue); by default all are cyan. A 16-bit image is scaled so
    that its largest value is white.
    """
    from PIL import Image, ImageDraw

    grey = image
    if grey.dtype != np.uint8:
        grey = np.rint(image * (255 / max(float(image.max()), 1.0))).astype(np.uint8)
    side = max(grey.shape)
    factor = max(_SMALLEST_PX // side, 1) if side <= _LARGEST_PX else _LARGEST_PX / side
    size = (max(round(grey.shape[1] * factor), 1), max(round(grey.shape[0] * factor), 1))
    resampling = Image.Resampling.NEAREST if factor >= 1 else Image.Resampling.BOX
    picture = Image.fromarray(grey).resize(size, resampling).convert("RGB")
    draw = ImageDraw.Draw(picture)
    rows = np.asarray(ellipses, np.float64).reshape(-1, 5)
    for index, (x, y, a, b, theta) in enumerate(rows):
        along, across = a * np.cos(_ANGLES), b * np.sin(_ANGLES)
        points = np.stack(
            [
                x + along * np.cos(theta) - across * np.sin(theta),
                y + along * np.sin(theta) + across * np.cos(theta),
            ],
            axis=1,
        )
        # Pillow's origin is the centre of the first pixel; the origin of labels is the outer corner of that pixel.
        drawn = points * factor - 0.5
        draw.line([(float(u), float(v)) for u, v in drawn], fill=CYAN if colours is None else colours[index], width=1)
    return picture


def display(picture: "Image") -> None:
    """Display a picture in the notebook if this process runs one, otherwise in the system's image viewer."""
    if "ipykernel" in sys.modules:
        from IPython.display import display as show_in_notebook

        show_in_notebook(picture)
    else:
        picture.show()
