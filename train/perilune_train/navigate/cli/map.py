"""`perilune-train navigate map`: crater catalogues from images of an orbiter."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap
from perilune_train.shipped.models import shipped_run


def make_map(
    dataset: Annotated[str, typer.Option(help="Dataset that `perilune-render survey` has made.")],
    detector: Annotated[
        Path | None, typer.Option(help="Folder of a detect run. [default: the detector that is installed]")
    ] = None,
    out: Annotated[Path, typer.Option(help="New folder for the catalogues.")] = Path("runs/navigate/map"),
    allow_overlap: AllowOverlap = False,
) -> None:
    """Make a crater catalogue of each scene from two images of an orbiter, with our own detector.

    Writes <scene_id>.parquet (x_m, y_m, z_m, diameter_m, score) for `navigate fly` and `navigate methods --map`,
    map.json (stated errors), map.md and errors.parquet (compared with the craters of the terrain), and map.png.
    """
    # torch takes seconds to load.
    from perilune_train.navigate.map.run import PAGE, map_scenes

    map_scenes(dataset, detector or shipped_run("detect"), out, allow_overlap)
    say(f"{out / PAGE}: errors and picture; one catalogue per scene beside it")
