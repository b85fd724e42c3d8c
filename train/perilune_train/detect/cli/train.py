"""`perilune-train detect train`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.config import resolve
from perilune_train.detect.config import DetectConfig
from perilune_train.evaluation.overlap_option import AllowOverlap


def train(
    preset: Annotated[str, typer.Option(help="tiny, small, paper or large: the settings to start from.")] = "small",
    config: Annotated[Path | None, typer.Option(help="YAML file whose section `detect` overrides the preset.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="One setting, for example detect.attention=none; wins over file and preset. Repeatable."
        ),
    ] = None,
    dataset: Annotated[Path | None, typer.Option(help="Folder of the dataset. [default: data/<preset>/detect]")] = None,
    runs: Annotated[Path, typer.Option("--out", "--runs", help="Folder that holds all runs.")] = Path("runs"),
    name: Annotated[str | None, typer.Option(help="Name of the run. [default: the preset]")] = None,
    allow_overlap: AllowOverlap = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a run of this name.")] = False,
) -> None:
    """Train the crater detector (attention YOLOv3) and evaluate it on the test split.

    Writes runs/detect/<name>/ with config.yaml, checkpoints/best.ckpt and last.ckpt, metrics.json, report.md,
    detections.parquet, detections.png, precision_recall.png and .parquet, bins.png and TensorBoard events. The same
    command resumes an interrupted run and leaves a finished one unchanged; --overwrite replaces it.

    The baseline without attention: perilune-train detect train --set detect.attention=none --name small-plain
    """
    settings = resolve(DetectConfig, "detect", "perilune_train", preset, config, tuple(set_ or ()))
    # Importing torch and Lightning takes seconds; check the settings first.
    from perilune_train.detect.train.run import run_detect

    run_detect(settings, dataset or Path("data", preset, "detect"), runs, name or preset, overwrite, allow_overlap)
