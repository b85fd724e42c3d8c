"""`perilune-train navigate calibrate`: fit the covariance that a warp network states."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.dataset.names import SPLITS
from perilune_shared.errors import UserError
from perilune_shared.terminal import say


def calibrate(
    run: Annotated[Path, typer.Option(help="Folder of a finished navigate run with a warp network.")],
    dataset: Annotated[
        str, typer.Option(help="Dataset of descents: a folder, s3://bucket/prefix or gs://bucket/prefix.")
    ],
    split: Annotated[str, typer.Option(help="train, val or test: the descents to fit to.")] = "val",
) -> None:
    """Fit the covariance that a warp network states to its errors on validation descents; writes covariance.json.

    Refuses test terrain. A training does this at its end. Use it for runs of earlier versions, or for another camera.
    """
    if split not in SPLITS:
        raise UserError("--split", "split", split, "one of " + ", ".join(SPLITS))
    # torch takes seconds to load.
    from perilune_shared.dataset.manifest import open_single
    from perilune_train.evaluation.provenance import check_calibration, read_provenance, split_terrain
    from perilune_train.navigate.covariance import FILE
    from perilune_train.navigate.covariance import calibrate as fit
    from perilune_train.navigate.data.trajectories import load_split
    from perilune_train.navigate.evaluate_run import fusion_of
    from perilune_train.navigate.network import load_navigator
    from perilune_train.training.runs import RunFolder, load_weights

    best = RunFolder(run).best
    fusion = fusion_of(best, load_weights(best)["architecture"])
    if fusion != "warp":
        raise UserError(best, "fusion", fusion, "warp; the paper's network states no covariance")
    opened = open_single(dataset)
    check_calibration(read_provenance(load_weights(best), best), split_terrain(opened, split, "calibrated"), opened)
    network, architecture = load_navigator(best, fusion)
    fit(run, network, architecture, load_split(opened, split))
    say(f"{run / FILE}")
