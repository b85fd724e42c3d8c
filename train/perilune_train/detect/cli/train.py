"""`perilune-train detect train`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.config import resolve
from perilune_train.cli_options import AllowOverlap, ConfigFile, Overwrite, Preset, RunName, RunsFolder, Settings
from perilune_train.detect.config import DetectConfig


def train(
    preset: Preset = "small",
    config: ConfigFile = None,
    set_: Settings = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            help="Dataset: a folder, s3://bucket/prefix or gs://bucket/prefix. [default: data/<preset>/detect]"
        ),
    ] = None,
    runs: RunsFolder = Path("runs"),
    name: RunName = None,
    allow_overlap: AllowOverlap = False,
    overwrite: Overwrite = False,
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
