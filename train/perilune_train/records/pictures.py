"""Write pictures atomically: figures of matplotlib and images of OpenCV."""

from pathlib import Path

import cv2
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray

from perilune_shared.storage.files import write_bytes, written_aside


def save_figure(path: Path, figure: Figure, dpi: int = 110) -> None:
    """Write a figure in the format of the file's suffix. Text is drawn literally: `$` does not begin a formula."""
    # Matplotlib writes the tick labels of logarithmic axes as formulas.
    axis_texts = {id(text) for axis in figure.findobj(Axis) for text in axis.findobj(Text) if text is not axis.label}
    for text in figure.findobj(Text):
        if id(text) not in axis_texts:
            text.set_parse_math(False)
    with written_aside(path) as aside:
        figure.savefig(aside, dpi=dpi)


def save_image(path: Path, image: NDArray) -> None:
    """Write an image, grey (height, width) or BGR (height, width, 3), in the format of the suffix."""
    encoded, content = cv2.imencode(path.suffix, image)
    if not encoded:
        raise OSError(f"{path}: cannot be written")
    write_bytes(path, content.tobytes())
