"""`perilune-train detect benchmark`: score a run, or another detector's detections, on the locked benchmark."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.errors import UserError
from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap
from perilune_train.detect.finished_run import check_output, config_of_run
from perilune_train.shipped.models import shipped_run


def benchmark(
    run: Annotated[
        Path | None, typer.Option(help="Folder of a finished detect run. [default: the detector that is installed]")
    ] = None,
    detections: Annotated[
        Path | None, typer.Option(help="Parquet or CSV table of another detector's detections, in place of --run.")
    ] = None,
    threshold: Annotated[
        float | None, typer.Option(help="With --detections: score threshold of precision, recall and F1.")
    ] = None,
    data: Annotated[str, typer.Option(help="Folder or address of the rendered benchmark.")] = "data/benchmark",
    manifests: Annotated[str, typer.Option(help="Folder or address of the shared manifests.")] = "data_manifests",
    out: Annotated[
        Path | None, typer.Option(help="Folder to write into. [default: runs/benchmark/<name of the run or table>]")
    ] = None,
    allow_overlap: AllowOverlap = False,
) -> None:
    """Score on the locked benchmark: benchmark.md, benchmark.json, and pictures by rule of labels."""
    if run is not None and detections is not None:
        raise UserError("benchmark", "options", "both --run and --detections", "one of them")
    if (threshold is None) != (detections is None):
        expected = "--threshold, chosen on other frames" if detections else "none: a run has its own threshold"
        raise UserError("--threshold", "score", threshold, expected)
    if threshold is not None and not 0 <= threshold <= 1:
        raise UserError("--threshold", "score", threshold, "a number from 0 to 1")
    from perilune_train.detect.benchmark.run import FIGURES, PAGE, score_run, score_submission

    if detections is not None and threshold is not None:
        folder = out or Path("runs/benchmark", detections.stem)
        made = score_submission(detections, detections.stem, threshold, data, manifests, folder)
    else:
        run = run or shipped_run("detect")
        folder = out or Path("runs/benchmark", run.resolve().name)
        check_output(folder, run)
        made = score_run(run, config_of_run(run), data, manifests, folder, allow_overlap)
    rule, account, value = made.least("ap50_paper")
    say(f"AP {value:.3f} by the least favourable account (labels by {rule}, {account}); {folder}: {PAGE}, {FIGURES}")
