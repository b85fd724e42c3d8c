"""`perilune-train navigate monte-carlo`: the filter over many draws of each descent."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.dataset.names import SPLITS
from perilune_shared.errors import UserError
from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap
from perilune_train.navigate.monte_carlo.scenario import SCENARIOS
from perilune_train.shipped.models import shipped_run


def monte_carlo(
    dataset: Annotated[
        str, typer.Option(help="Dataset of descents: a folder, s3://bucket/prefix or gs://bucket/prefix.")
    ],
    detector: Annotated[
        Path | None, typer.Option(help="Folder of a detect run. [default: the detector that is installed]")
    ] = None,
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    scenario: Annotated[str, typer.Option(help="What goes wrong: " + ", ".join(SCENARIOS) + ".")] = "nominal",
    draws: Annotated[int, typer.Option(min=1, max=100_000, help="Draws of each descent.")] = 200,
    attitude_deg: Annotated[
        float, typer.Option(min=0.001, max=10, help="Standard deviation of the attitude at the start, on each axis.")
    ] = 0.5,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all draws.")] = 0,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes. [default: one per core]")] = None,
    out: Annotated[Path, typer.Option(help="New folder for the results.")] = Path("runs/navigate/monte-carlo"),
    allow_overlap: AllowOverlap = False,
) -> None:
    """Fly the filter over random starts, catalogues and inertial errors of each descent.

    The detector runs once over every frame; all draws use its detections. Writes monte_carlo.md (table and pictures),
    draws.parquet (one row per draw and frame), errors.png and consistency.png.
    """
    if split not in SPLITS:
        raise UserError("--split", "split", split, "one of " + ", ".join(SPLITS))
    if scenario not in SCENARIOS:
        raise UserError("--scenario", "scenario", scenario, "one of " + ", ".join(SCENARIOS))
    # torch takes seconds to load.
    from perilune_train.navigate.monte_carlo.run import PAGE, fly_draws

    own = detector or shipped_run("detect")
    fly_draws(dataset, split, own, out, scenario, draws, attitude_deg, seed, workers, allow_overlap)
    say(f"{out / PAGE}: table and pictures; draws.parquet")
