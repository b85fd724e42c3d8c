"""`perilune-train navigate benchmark-landing`: score craters and the filter on the locked benchmark."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap
from perilune_train.shipped.models import shipped_run


def benchmark_landing(
    detector: Annotated[
        Path | None, typer.Option(help="Folder of a finished detect run. [default: the detector that is installed]")
    ] = None,
    data: Annotated[str, typer.Option(help="Folder or address of the rendered benchmark.")] = "data/benchmark",
    manifests: Annotated[str, typer.Option(help="Folder or address of the shared manifests.")] = "data_manifests",
    maps: Annotated[
        Path | None, typer.Option("--maps", help="Folder with one map by `navigate map` for each part, by its name.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="New folder. [default: runs/benchmark/<name of the run>-landing]")
    ] = None,
    allow_overlap: AllowOverlap = False,
) -> None:
    """Score poses from craters and the filter on the locked benchmark: benchmark.md, benchmark.json, frames.parquet."""
    # torch takes seconds to load.
    from perilune_train.navigate.methods.benchmark import FIGURES, PAGE, POSITION, score_landing

    run = detector or shipped_run("detect")
    folder = out or Path("runs/benchmark", f"{run.resolve().name}-landing")
    figures = score_landing(run, data, manifests, folder, maps, allow_overlap)
    if f"filter/{POSITION}" in figures:
        say(f"filter: position RMSE {figures[f'filter/{POSITION}']:.3f} m")
    say(f"{folder}: {PAGE}, {FIGURES}, frames.parquet")
