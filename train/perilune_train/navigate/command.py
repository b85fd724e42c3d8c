"""`perilune-train navigate`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.config import resolve
from perilune_shared.terminal import console
from perilune_train.evaluation.overlap_option import AllowOverlap
from perilune_train.navigate.config import NavigateConfig


def navigate(
    preset: Annotated[str, typer.Option(help="tiny, small, paper or large: the settings to start from.")] = "small",
    config: Annotated[
        Path | None, typer.Option(help="YAML file whose section `navigate` overrides the preset.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="One setting, for example navigate.fusion=warp; wins over file and preset. Repeatable."
        ),
    ] = None,
    dataset: Annotated[Path | None, typer.Option(help="Folder of the dataset. [default: data/<preset>/nav]")] = None,
    runs: Annotated[Path, typer.Option("--out", "--runs", help="Folder that holds all runs.")] = Path("runs"),
    name: Annotated[str | None, typer.Option(help="Name of the run. [default: the preset]")] = None,
    allow_overlap: AllowOverlap = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace runs of this name.")] = False,
) -> None:
    """Train the navigation networks and evaluate them beside the nominal motion, mean motions and KLT tracks.

    Writes runs/navigate/<name>/ (fusion warp) and runs/navigate/<name>-stack/ (fusion stack, the paper's network), each
    with config.yaml, checkpoints/best.ckpt and last.ckpt, metrics.json, navigation.parquet (one row per method),
    errors.parquet (one row per pair), descent.png, errors.png and TensorBoard events. The stack network starts from the
    backbone of runs/detect/<name>, if that fits. The same command resumes an interrupted run and leaves finished ones
    unchanged; --overwrite replaces them.
    """
    settings = resolve(NavigateConfig, "navigate", "perilune_train", preset, config, tuple(set_ or ()))
    # Importing torch and Lightning takes seconds; check the settings first.
    from perilune_train.navigate.run import navigate_run

    name = name or preset
    detector = runs / "detect" / name / "checkpoints" / "best.ckpt"
    dataset = dataset or Path("data", preset, "nav")
    for run in navigate_run(settings, dataset, runs, name, detector, overwrite, allow_overlap):
        console.print(f"{run.root}: metrics.json, navigation.parquet, descent.png, errors.png")
