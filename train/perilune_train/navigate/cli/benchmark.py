"""`perilune-train navigate benchmark`: score a navigator on the locked benchmark."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap
from perilune_train.shipped.models import shipped_run


def benchmark(
    run: Annotated[
        Path | None, typer.Option(help="Folder of a finished navigate run. [default: the navigator that is installed]")
    ] = None,
    data: Annotated[str, typer.Option(help="Folder or address of the rendered benchmark.")] = "data/benchmark",
    manifests: Annotated[str, typer.Option(help="Folder or address of the shared manifests.")] = "data_manifests",
    out: Annotated[
        Path | None, typer.Option(help="Folder to write into. [default: runs/benchmark/<name of the run>-navigate]")
    ] = None,
    allow_overlap: AllowOverlap = False,
) -> None:
    """Score on the locked benchmark: benchmark.md, benchmark.json, tables of errors and pictures."""
    # torch takes seconds to load.
    from perilune_train.navigate.benchmark import FIGURES, HEADLINE, PAGE, score_navigator

    run = run or shipped_run("navigate")
    folder = out or Path("runs/benchmark", f"{run.resolve().name}-navigate")
    figures = score_navigator(run, data, manifests, folder, allow_overlap)
    say(f"position RMSE {figures[f'headline/{HEADLINE}']:.3f} m; {folder}: {PAGE}, {FIGURES}")
