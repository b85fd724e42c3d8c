"""`perilune-train causal`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.config import resolve
from perilune_shared.errors import UserError
from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap, ConfigFile, Overwrite, Preset, RunsFolder, Settings
from perilune_train.evaluation.metrics_file import METRICS_FILE, read_metrics
from perilune_train.explain.config import ExplainConfig
from perilune_train.shipped.models import shipped_run


def causal(
    preset: Preset = "small",
    config: ConfigFile = None,
    set_: Settings = None,
    dataset: Annotated[
        str | None, typer.Option(help="Detection dataset with all craters. [default: data/<preset>/detect]")
    ] = None,
    counterfactual: Annotated[
        str | None,
        typer.Option(
            help="The same frames without some craters, from `perilune-render counterfactual`."
            " [default: data/<preset>/causal]"
        ),
    ] = None,
    turned: Annotated[str | None, typer.Option(help="The same frames under another Sun, with all craters.")] = None,
    split: Annotated[str, typer.Option(help="Split of the frames.")] = "test",
    runs: RunsFolder = Path("runs"),
    name: Annotated[
        str | None, typer.Option(help="Name of the run, and of the detect run that it explains. [default: the preset]")
    ] = None,
    run: Annotated[
        Path | None,
        typer.Option(help="Folder of a detect run. [default: runs/detect/<name>; the installed detector if absent]"),
    ] = None,
    gate: Annotated[
        str | None,
        typer.Option(help="Gate of the headline, such as B_22. [default: that of runs/explain/<name>, else B_11]"),
    ] = None,
    nav_dataset: Annotated[str | None, typer.Option(help="Navigation dataset with all craters, for poses.")] = None,
    nav_counterfactual: Annotated[
        str | None, typer.Option(help="The same descents without some craters, with all their frames.")
    ] = None,
    navigator: Annotated[
        Path | None,
        typer.Option(help="A stack navigator's best.ckpt. [default: runs/navigate/<name>-stack/checkpoints/best.ckpt]"),
    ] = None,
    allow_overlap: AllowOverlap = False,
    overwrite: Overwrite = False,
) -> None:
    """Measure what single craters do to attention masks, detections and poses.

    Compares frames rendered with and without some craters, everything else equal. Writes runs/explain/<name>-causal/
    with the tables of all effects, pictures, claims.json and metrics.json. Leaves a finished run of the same inputs
    unchanged; --overwrite replaces it.
    """
    settings = resolve(ExplainConfig, "explain", "perilune_train", preset, config, tuple(set_ or ()))
    if (nav_dataset is None) != (nav_counterfactual is None):
        raise UserError("--nav-dataset", "datasets", "one of two", "--nav-dataset and --nav-counterfactual together")
    # Importing torch and Lightning takes seconds; check the settings first.
    from perilune_train.explain.causal.run import causal_run
    from perilune_train.training.runs import RunFolder

    name = name or preset
    own = run or runs / "detect" / name
    if run is None and not own.is_dir():
        own = shipped_run("detect")
    pose = None
    if nav_dataset is not None and nav_counterfactual is not None:
        best = navigator or runs / "navigate" / f"{name}-stack" / "checkpoints" / "best.ckpt"
        pose = nav_dataset, nav_counterfactual, best
    made = causal_run(
        settings,
        dataset or f"data/{preset}/detect",
        counterfactual or f"data/{preset}/causal",
        RunFolder(own).best,
        gate or _chosen_gate(runs / "explain" / name),
        runs,
        name,
        split,
        turned,
        pose,
        overwrite,
        allow_overlap,
    )
    say(f"{made.root}: metrics.json, claims.json, *.parquet, *.png")


def _chosen_gate(explained: Path) -> str:
    """The gate that an explain run chose on validation frames; B_11, the paper's first, if there is no such run."""
    found = read_metrics(explained).get("detect/strongest_gate") if (explained / METRICS_FILE).is_file() else None
    return found if isinstance(found, str) else "B_11"
