"""`perilune-train explain`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from perilune_shared.config import resolve
from perilune_shared.errors import UserError
from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap, ConfigFile, Overwrite, Preset, RunsFolder, Settings
from perilune_train.explain.config import ExplainConfig
from perilune_train.shipped.models import shipped_run


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
    task: Annotated[
        Literal["both", "detect", "navigate"],
        typer.Option(help="Networks to explain. With `detect` no navigator is needed, with `navigate` no detector."),
    ] = "both",
    detector: Annotated[
        Path | None,
        typer.Option(
            help="A detector's best.ckpt in its run's folder. [default: runs/detect/<name>/checkpoints/best.ckpt;"
            " with --task detect the installed detector if there is no such run]"
        ),
    ] = None,
    navigator: Annotated[
        Path | None,
        typer.Option(help="A stack navigator's best.ckpt. [default: runs/navigate/<name>-stack/checkpoints/best.ckpt]"),
    ] = None,
    allow_overlap: AllowOverlap = False,
    overwrite: Overwrite = False,
) -> None:
    """Test what attention gates show: nulls, interventions, localisation, stability.

    Computes the paper's correlations PCC1 to PCC4 of each gate and of null maps. A gate counts only if it beats every
    null. PCC1 above 0 means that a gate is weaker on craters; pcc1_craterness has the opposite sign.

    Writes runs/explain/<name>/ with claims.json, metrics.json, the tables of all values and pictures. Leaves a finished
    run of the same settings, datasets and checkpoints unchanged; --overwrite replaces it.
    """
    settings = resolve(ExplainConfig, "explain", "perilune_train", preset, config, tuple(set_ or ()))
    # Importing torch and Lightning takes seconds; check the settings first.
    from perilune_train.explain.run import explain_run
    from perilune_train.training.runs import RunFolder

    name, above = name or preset, (dataset or f"data/{preset}").rstrip("/")
    for given, option, other in ((detector, "--detector", "navigate"), (navigator, "--navigator", "detect")):
        if given is not None and task == other:
            raise UserError(option, "option", str(given), f"nothing beside --task {other}")
    if task != "navigate" and detector is None:
        own = runs / "detect" / name
        detector = RunFolder(shipped_run("detect") if task == "detect" and not own.is_dir() else own).best
    if task != "detect" and navigator is None:
        navigator = RunFolder(runs / "navigate" / f"{name}-stack").best
    run = explain_run(
        settings, f"{above}/detect", f"{above}/nav", detector, navigator, runs, name, overwrite, allow_overlap
    )
    say(f"{run.root}: claims.json, metrics.json, *.parquet, *.png")
