"""The command line option that allows test terrain that a network was trained on."""

from typing import Annotated

import typer

AllowOverlap = Annotated[
    bool,
    typer.Option(
        "--allow-overlap",
        help="Allow test terrain that the network was trained on; marks every figure and picture.",
    ),
]
