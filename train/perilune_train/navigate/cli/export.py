"""`perilune-train navigate export`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.terminal import say
from perilune_train.shipped.models import shipped_run


def export(
    out: Annotated[Path, typer.Option(help="New folder for the files.")],
    run: Annotated[
        Path | None, typer.Option(help="Folder of a finished navigate run. [default: the navigator that is installed]")
    ] = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            help="Dataset (folder or address): export for its camera, and compare with torch on its validation frames."
        ),
    ] = None,
) -> None:
    """Write a trained navigator as an ONNX file, for flight: one pair of frames and the state in, motion and state out.

    Writes navigator.onnx, navigator.json (sizes, camera, normalisation) and README.md with a program that uses them.
    The file is run pair by pair and compared with torch over the whole sequence first; without a dataset on noise.
    """
    # torch takes seconds to load.
    from perilune_train.navigate.deploy.export import export_navigator

    largest = export_navigator(run or shipped_run("navigate"), out, dataset)
    say(f"{out}: README.md explains how to use the files; difference from torch {largest:.1e}")
