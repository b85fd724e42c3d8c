"""Options of the commands that cut images into tiles."""

from typing import Annotated

import typer

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
Overlap = Annotated[int, typer.Option(help="Minimum overlap of two tiles, pixels.")]
