"""`perilune-train navigate methods`: all methods over the descents of a split."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.dataset.names import SPLITS
from perilune_shared.errors import UserError
from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap
from perilune_train.shipped.models import shipped_run


def methods(
    dataset: Annotated[
        str, typer.Option(help="Dataset of descents: a folder, s3://bucket/prefix or gs://bucket/prefix.")
    ],
    run: Annotated[
        Path | None, typer.Option(help="Folder of a finished navigate run. [default: the navigator that is installed]")
    ] = None,
    detector: Annotated[
        Path | None, typer.Option(help="Folder of a detect run. [default: the detector that is installed]")
    ] = None,
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    out: Annotated[Path, typer.Option(help="New folder for the results.")] = Path("runs/navigate/methods"),
    maps: Annotated[
        Path | None, typer.Option("--map", help="Folder of a map by `navigate map`, a further catalogue.")
    ] = None,
    allow_overlap: AllowOverlap = False,
) -> None:
    """Fly all methods over a split: learned and classical motion, poses from craters, lost in space, the filter.

    Writes methods.md (tables and pictures), navigation.parquet (one row per method), frames.parquet (one row per
    frame and absolute method), altitude.png, flights.png, matches_high.png, matches_low.png, inputs.json and
    metrics.json (hashes, command, commit, versions). Catalogues, priors and starts are drawn with a fixed seed.
    """
    if split not in SPLITS:
        raise UserError("--split", "split", split, "one of " + ", ".join(SPLITS))
    # torch takes seconds to load.
    from perilune_train.navigate.methods.run import PAGE, fly_methods

    networks = run or shipped_run("navigate"), detector or shipped_run("detect")
    fly_methods(dataset, split, *networks, out, allow_overlap, maps)
    say(f"{out / PAGE}: tables and pictures; navigation.parquet, frames.parquet")
