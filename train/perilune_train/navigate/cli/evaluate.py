"""`perilune-train navigate evaluate`: evaluate a finished navigation run on a split of any dataset."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.dataset.names import SPLITS
from perilune_shared.errors import UserError
from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap
from perilune_train.shipped.models import shipped_run


def evaluate(
    dataset: Annotated[str, typer.Option(help="Dataset: a folder, s3://bucket/prefix or gs://bucket/prefix.")],
    run: Annotated[
        Path | None, typer.Option(help="Folder of a finished navigate run. [default: the navigator that is installed]")
    ] = None,
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder to write into. [default: <run>/evaluation; runs/evaluation/<name> without --run]"),
    ] = None,
    allow_overlap: AllowOverlap = False,
) -> None:
    """Evaluate a run's best weights together with KLT tracks and the nominal motion.

    Writes metrics.json, navigation.parquet (one row per method), errors.parquet (one row per pair), descent.png and
    errors.png. A run for poses (navigate.stack.target=pose) is evaluated over the landing area of its training, beside
    the mean pose, with pose.md in place of descent.png.
    """
    if split not in SPLITS:
        raise UserError("--split", "split", split, "one of " + ", ".join(SPLITS))
    # torch takes seconds to load.
    from perilune_train.navigate.evaluate_run import evaluate_navigator

    default = run / "evaluation" if run else Path("runs/evaluation", "lander-navigator")
    folder = evaluate_navigator(run or shipped_run("navigate"), dataset, split, out or default, allow_overlap)
    say(f"{folder}: metrics.json, navigation.parquet, errors.parquet, errors.png")
