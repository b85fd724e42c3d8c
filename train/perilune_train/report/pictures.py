"""Pictures embedded in a page: matplotlib figures as inline SVG, images as data URIs."""

import base64
import io
import itertools
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import cv2
import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray
from PIL import Image

from perilune_shared.dataset.metadata import LARGEST_IMAGE_PX
from perilune_shared.errors import UserError, one_line, shortened

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""The colours of Okabe and Ito that are legible on both white and black."""
DASHES: tuple[str | tuple[float, tuple[float, ...]], ...] = (
    "-", "--", "-.", ":", (0, (7, 2, 1, 2, 1, 2)), (0, (2, 1)),
)  # fmt: skip
"""One dash pattern per colour, so that lines can be told apart without colour."""
WIDTH_IN = 5.0
"""Width of a figure, inches. The text is legible if the figure fills half of a wide page, or a whole narrow page."""
_INK, _INK_RGB = "#010203", re.compile(r"#010203")
_SVG, _LINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
_FONT = re.compile(r"(?:^|\s)(\d+(?:\.\d+)?)px")
_STYLE = {
    "svg.fonttype": "none",
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _INK,
    "axes.labelcolor": _INK,
    "axes.titlecolor": _INK,
    "text.color": _INK,
    "text.parse_math": False,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "axes.titlesize": 10,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "legend.framealpha": 0.0,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.7,
}
_MAX_SIDE_PX = 1400
_QUALITY = 82
_WHITE = 250
_MIN_PAPER_SHARE = 0.01
_MIN_PATCH_PX = 60
"""Smallest white area, pixels, that counts as paper beyond a line. Bright spots in photographs are mostly smaller."""
_STROKE_PX = 13
"""Largest width of a line or letter on paper, pixels."""
_MAX_INK_SPREAD = 24
"""Largest difference between the channels, of 255, of a pixel that counts as grey. Compression shifts the channels."""
_numbers = itertools.count()
ElementTree.register_namespace("", _SVG)
ElementTree.register_namespace("xlink", _LINK)


@contextmanager
def drawing(width_in: float = WIDTH_IN, height_in: float = 3.4) -> Iterator[Drawing]:
    """Yield an empty figure in the report's style. Draw on it and call `svg_of` within the block."""
    with matplotlib.rc_context(_STYLE):
        yield Drawing(figsize=(width_in, height_in), layout="constrained")


def label_axes(axes: Axes, title: str, x: str, y: str) -> None:
    """Set the title and both axis labels. Names from data are drawn literally, because text.parse_math is off."""
    axes.set(title=title, xlabel=x, ylabel=y)


def logarithmic(axes: Axes, *which: Literal["x", "y"]) -> None:
    """Make axes logarithmic, with plain numbers at powers of ten. Axes of less than two decades also have 2 and 5."""
    for name in which:
        (axes.set_xscale if name == "x" else axes.set_yscale)("log")
        axis = axes.xaxis if name == "x" else axes.yaxis
        low, high = axis.get_view_interval()
        few = low > 0 and high / low < 100
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,)))
        # Matplotlib's default labels are mathematical text, which is off (text.parse_math).
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
        axis.set_minor_locator(NullLocator())


def svg_of(figure: Drawing, description: str) -> Markup:
    """A figure as inline SVG whose text and axes have the colour of the page's text.

    Styles become presentation attributes, since the page's security policy allows no inline styles. Identifiers are
    unique within this process. `description` is read by screen readers.
    """
    stream = io.StringIO()
    figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    root = ElementTree.fromstring(stream.getvalue())
    prefix = f"f{next(_numbers)}-"
    for parent in root.iter():
        for child in list(parent):
            if child.tag in (f"{{{_SVG}}}style", f"{{{_SVG}}}metadata"):
                parent.remove(child)
    for element in root.iter():
        for name, value in _presentation(element.attrib.pop("style", "")).items():
            element.set(name, value)
        for name, value in list(element.attrib.items()):
            value = _INK_RGB.sub("currentColor", value)
            value = value.replace("url(#", f"url(#{prefix}")
            if name == "id" or (name == f"{{{_LINK}}}href" and value.startswith("#")):
                value = f"#{prefix}{value[1:]}" if value.startswith("#") else prefix + value
            element.set(name, value)
    root.set("role", "img")
    root.set("aria-label", description)
    root.set("class", "plot")
    for size in ("width", "height"):
        root.attrib.pop(size, None)
    return Markup(ElementTree.tostring(root, encoding="unicode"))


def _presentation(style: str) -> dict[str, str]:
    """Convert a CSS style to presentation attributes. Of `font`, only the size is kept."""
    attributes = {}
    for part in style.split(";"):
        name, _, value = (text.strip() for text in part.partition(":"))
        if name == "font" and (size := _FONT.search(value)):
            attributes["font-size"] = size.group(1)
        elif name and name != "font":
            attributes[name] = value
    return attributes


def png_uri(content: bytes) -> str:
    """A data URI of a PNG."""
    return "data:image/png;base64," + base64.b64encode(content).decode()


def image_uri(image: Image.Image | NDArray[np.uint8], quality: int = _QUALITY) -> str:
    """A data URI of an image as WebP. Arrays are grey images (height, width)."""
    stream = io.BytesIO()
    (Image.fromarray(image) if isinstance(image, np.ndarray) else image).save(stream, "WEBP", quality=quality)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode()


def img(uri: str, description: str) -> Markup:
    """An `img` element."""
    return Markup('<img src="{}" alt="{}">').format(uri, description)


def picture_of(path: Path, description: str) -> Markup:
    """Embed a run's PNG as HTML, reduced to at most 1400 px. Raises UserError if it is damaged or too large.

    White paper around the content becomes transparent. Black ink on the paper becomes a second image, which the page
    inverts in dark mode.
    """
    try:
        with Image.open(path, formats=["PNG"]) as picture:
            if picture.width * picture.height > LARGEST_IMAGE_PX:
                raise ValueError(f"{picture.width} x {picture.height} pixels")
            colours = picture.convert("RGB")
    except (ValueError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise UserError(path, "picture", error, f"a PNG of at most {LARGEST_IMAGE_PX} pixels") from None
    # `thumbnail` reduces pictures that are too large for the page and does not enlarge small ones.
    colours.thumbnail((_MAX_SIDE_PX, 4 * _MAX_SIDE_PX))
    layers = layers_of(np.asarray(colours))
    if layers is None:
        return img(image_uri(colours), description)
    content, ink = (image_uri(Image.fromarray(layer)) for layer in layers)
    element = Markup('<span class="layers">{}<img class="ink" src="{}" alt=""></span>')
    return element.format(img(content, description), ink)


def layers_of(colours: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]] | None:
    """Split a picture (height, width, 3) into two layers (height, width, 4): content, and black ink.

    Drawn together over white, the layers give the picture. Returns None if the picture has no white paper.
    """
    paper = _paper(colours)
    if paper is None:
        return None
    values = colours.astype(np.float64)
    # Smallest opacity with which a colour over white can give the pixel. Black ink gets this opacity. Coloured lines
    # get a larger opacity, because with the smallest opacity they would be too dark over black.
    least = (255 - values.min(axis=2)) / 255
    share = np.where(paper, np.sqrt(least), 1.0)
    pure = 255 - (255 - values) / np.maximum(share, 1 / 255)[..., None]
    content = np.dstack([np.clip(pure, 0, 255), 255 * share])
    is_ink = paper & (np.ptp(colours, axis=2) <= _MAX_INK_SPREAD)
    ink = np.zeros_like(content)
    ink[..., 3] = np.where(is_ink, 255 * least, 0)
    content[is_ink] = 0
    return content.round().astype(np.uint8), ink.round().astype(np.uint8)


def _paper(colours: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
    """Pixels (height, width) of a picture (height, width, 3) that are white paper, or thin lines and letters on it.

    Photographs and filled shapes are not paper. Paper starts at each large white area and continues beyond lines.
    Returns None if there is no large white area.
    """
    _, parts, facts, _ = cv2.connectedComponentsWithStats((colours.min(axis=2) >= _WHITE).astype(np.uint8))
    area = facts[:, cv2.CC_STAT_AREA]
    area[0] = 0  # component 0: all pixels that are not white
    known = area >= _MIN_PAPER_SHARE * parts.size
    if not known.any():
        return None
    shape = cv2.getStructuringElement(cv2.MORPH_RECT, (_STROKE_PX, _STROKE_PX))
    while True:
        near = np.unique(parts[cv2.dilate(known[parts].astype(np.uint8), shape) > 0])
        added = near[~known[near] & (area[near] >= _MIN_PATCH_PX)]
        if not len(added):
            break
        known[added] = True
    # Morphological closing adds the lines and letters, and keeps the straight edges of photographs.
    return cv2.morphologyEx(known[parts].astype(np.uint8), cv2.MORPH_CLOSE, shape).astype(bool)


def plain(text: object) -> str:
    """Make a name from a file safe for a figure: one printable line of at most 60 characters."""
    return shortened(one_line(text), 60)
