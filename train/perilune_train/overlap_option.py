"""The option that lets a test on terrain of the training through."""

from typing import Annotated

import typer

AllowOverlap = Annotated[
    bool,
    typer.Option(
        "--allow-overlap",
        help="Go on where test terrain served for training; every figure and picture is marked then.",
    ),
]
