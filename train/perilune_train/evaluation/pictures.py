"""Write pictures atomically: figures of matplotlib and images of OpenCV."""

from pathlib import Path

import cv2
from matplotlib.figure import Figure
from numpy.typing import NDArray

from perilune_shared.storage.files import write_bytes, written_aside


def save_figure(path: Path, figure: Figure, dpi: int = 110) -> None:
    """Write a figure in the format of the file's suffix."""
    with written_aside(path) as aside:
        figure.savefig(aside, dpi=dpi)


def save_image(path: Path, image: NDArray) -> None:
    """Write an image, grey (height, width) or blue, green, red (height, width, 3), in the format of the suffix."""
    encoded, content = cv2.imencode(path.suffix, image)
    if not encoded:
        raise OSError(f"{path}: cannot be written")
    write_bytes(path, content.tobytes())
