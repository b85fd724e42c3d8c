"""Options of the commands that cut images into tiles."""

from typing import Annotated

import typer

from perilune_shared.errors import UserError

Scales = Annotated[
    list[float] | None,
    typer.Option(
        "--scale",
        help="Factor by which images are resized before detection. Repeatable; detections at all scales are merged."
        " [default: those of the run]",
    ),
]
TileSide = Annotated[
    int, typer.Option("--tile", help="Side of the tiles, pixels; best is the side of the training frames.")
]
BoxMargin = Annotated[
    float,
    typer.Option(
        help="Margin added to every side of the detected boxes, pixels. They end at the crest of the rim; use 0.5 to"
        " compare them with labels that are boxes of whole pixels around a crater."
    ),
]
NoData = Annotated[
    float | None,
    typer.Option(
        help="Value of pixels without data, if the files do not declare it. [default: found where it stands apart]"
    ),
]
Overlap = Annotated[int, typer.Option(help="Minimum overlap of two tiles, pixels.")]


def check_nodata(value: float | None) -> None:
    """Raise UserError if it is not a finite number."""
    if value is not None and not abs(value) < float("inf"):
        raise UserError("--nodata", "value", value, "a finite number; others are always taken as no data")
