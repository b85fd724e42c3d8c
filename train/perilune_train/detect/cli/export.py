"""`perilune-train detect export`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.errors import UserError
from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap
from perilune_train.shipped.models import shipped_run


def export(
    out: Annotated[Path, typer.Option(help="New folder for the files.")],
    run: Annotated[
        Path | None, typer.Option(help="Folder of a finished run. [default: the detector that is installed]")
    ] = None,
    formats: Annotated[str, typer.Option(help="onnx, openvino, or both separated by a comma.")] = "onnx,openvino",
    size_px: Annotated[int, typer.Option(help="Side of the square images, a multiple of 32.")] = 256,
    dataset: Annotated[
        str | None,
        typer.Option(help="Dataset (folder or address); the files are compared with torch on its validation frames."),
    ] = None,
    int8: Annotated[bool, typer.Option("--int8", help="Also try 8-bit integers; needs --dataset.")] = False,
    allow_overlap: AllowOverlap = False,
) -> None:
    """Write a trained detector as ONNX and OpenVINO files, for flight.

    Writes detector.onnx, detector.xml and .bin, detector.json (anchors, threshold, normalisation) and README.md. Every
    file is run and compared with torch first. --int8 adds detector-int8.onnx, quantised on training frames, only if it
    is faster and loses at most 0.005 of AP on the validation frames.
    """
    asked = tuple(part.strip() for part in formats.split(","))
    if not set(asked) <= {"onnx", "openvino"}:
        raise UserError("options", "--formats", formats, "onnx, openvino or onnx,openvino")
    if size_px <= 0 or size_px % 32:
        raise UserError("options", "--size-px", size_px, "a multiple of 32")
    if int8 and dataset is None:
        raise UserError("options", "--int8", "no --dataset", "a dataset to calibrate and to evaluate on")
    # Importing torch takes seconds; check the options first.
    from perilune_train.detect.deploy.export import export_run

    export_run(run or shipped_run("detect"), out, asked, size_px, dataset, int8, allow_overlap)
    say(f"{out}: README.md explains how to use the files")
