"""`perilune-train explain`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.config import resolve
from perilune_shared.terminal import console
from perilune_train.cli_options import AllowOverlap, ConfigFile, Overwrite, Preset, RunsFolder, Settings
from perilune_train.explain.config import ExplainConfig


def explain(
    preset: Preset = "small",
    config: ConfigFile = None,
    set_: Settings = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            help="Folder, s3://bucket/prefix or gs://bucket/prefix that holds the datasets detect and nav."
            " [default: data/<preset>]"
        ),
    ] = None,
    runs: RunsFolder = Path("runs"),
    name: Annotated[
        str | None,
        typer.Option(
            help="Name of the run, and of the detect and navigate runs that it explains. [default: the preset]"
        ),
    ] = None,
    detector: Annotated[
        Path | None,
        typer.Option(
            help="A detector's best.ckpt in its run's folder. [default: runs/detect/<name>/checkpoints/best.ckpt]"
        ),
    ] = None,
    navigator: Annotated[
        Path | None,
        typer.Option(help="A stack navigator's best.ckpt. [default: runs/navigate/<name>-stack/checkpoints/best.ckpt]"),
    ] = None,
    allow_overlap: AllowOverlap = False,
    overwrite: Overwrite = False,
) -> None:
    """Test what the attention gates of both networks show: nulls, interventions, localisation, stability.

    Computes the paper's correlations PCC1 to PCC4 of each gate and of null maps. A gate counts only if it beats every
    null. PCC1 above 0 means that a gate is weaker on craters; pcc1_craterness has the opposite sign.

    Writes runs/explain/<name>/ with claims.json, metrics.json, the tables of all values and pictures. Leaves a finished
    run of the same settings, datasets and checkpoints unchanged; --overwrite replaces it.
    """
    settings = resolve(ExplainConfig, "explain", "perilune_train", preset, config, tuple(set_ or ()))
    # Importing torch and Lightning takes seconds; check the settings first.
    from perilune_train.explain.run import explain_run

    name, above = name or preset, (dataset or f"data/{preset}").rstrip("/")
    run = explain_run(
        settings,
        f"{above}/detect",
        f"{above}/nav",
        detector or runs / "detect" / name / "checkpoints" / "best.ckpt",
        navigator or runs / "navigate" / f"{name}-stack" / "checkpoints" / "best.ckpt",
        runs,
        name,
        overwrite,
        allow_overlap,
    )
    console.print(f"{run.root}: claims.json, metrics.json, *.parquet, *.png")
