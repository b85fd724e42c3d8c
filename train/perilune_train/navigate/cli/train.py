"""`perilune-train navigate train`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.config import resolve
from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap, ConfigFile, Overwrite, Preset, RunName, RunsFolder, Settings
from perilune_train.navigate.config import NavigateConfig


def train(
    preset: Preset = "small",
    config: ConfigFile = None,
    set_: Settings = None,
    dataset: Annotated[
        str | None,
        typer.Option(help="Dataset: a folder, s3://bucket/prefix or gs://bucket/prefix. [default: data/<preset>/nav]"),
    ] = None,
    runs: RunsFolder = Path("runs"),
    name: RunName = None,
    allow_overlap: AllowOverlap = False,
    overwrite: Overwrite = False,
) -> None:
    """Train the navigation networks and evaluate them together with the nominal motion, mean motions and KLT tracks.

    Writes runs/navigate/<name>/ (fusion warp) and runs/navigate/<name>-stack/ (fusion stack, the paper's network), each
    with config.yaml, checkpoints/best.ckpt and last.ckpt, metrics.json, navigation.parquet (one row per method),
    errors.parquet (one row per pair), descent.png, errors.png and TensorBoard events. With navigate.stack.target=pose
    the stack run has pose.md (the table) in place of descent.png. The stack network is initialised
    with the backbone of runs/detect/<name>, if that has the same architecture. The same command resumes an interrupted
    run and leaves finished ones unchanged; --overwrite replaces them.
    """
    settings = resolve(NavigateConfig, "navigate", "perilune_train", preset, config, tuple(set_ or ()))
    # Importing torch and Lightning takes seconds; check the settings first.
    from perilune_train.navigate.train.run import navigate_run

    name = name or preset
    detector = runs / "detect" / name / "checkpoints" / "best.ckpt"
    address = dataset or Path("data", preset, "nav")
    for run in navigate_run(settings, address, runs, name, detector, overwrite, allow_overlap):
        say(f"{run.root}: metrics.json, navigation.parquet, errors.png")
