"""`perilune-train explain` and `causal`: what attention gates show, and the effect of single craters."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from perilune_shared.config.resolve import resolve
from perilune_shared.console.terminal import say
from perilune_shared.errors import UserError
from perilune_train.cli.options import AllowOverlap, ConfigFile, Overwrite, Preset, RunsFolder, Settings
from perilune_train.explain.config import ExplainConfig
from perilune_train.records.metrics_file import METRICS_FILE, read_metrics
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
    """Test what attention gates show: comparison with null maps, interventions, localisation, stability.

    Computes the paper's correlations PCC1 to PCC4 of each gate and of null maps. A gate is evidence only if it
    beats every null map. PCC1 above 0 means that a gate is weaker on craters; pcc1_craterness has the opposite sign.

    Writes runs/explain/<name>/ with claims.json, metrics.json, the tables of all values and pictures. Leaves a finished
    run of the same settings, datasets and checkpoints unchanged; --overwrite replaces it.
    """
    settings = resolve(ExplainConfig, "explain", "perilune_train", preset, config, tuple(set_ or ()))
    # Importing torch and Lightning takes seconds; check the settings first.
    from perilune_train.explain.explain_run import NetworkOnData, explain_run
    from perilune_train.training.runs import NamedRun, RunFolder

    name, above = name or preset, (dataset or f"data/{preset}").rstrip("/")
    for checkpoint, option, other_task in ((detector, "--detector", "navigate"), (navigator, "--navigator", "detect")):
        if checkpoint is not None and task == other_task:
            raise UserError(option, "", str(checkpoint), f"no {option} with --task {other_task}")
    if task != "navigate" and detector is None:
        run_folder = runs / "detect" / name
        detector = RunFolder(shipped_run("detect") if task == "detect" and not run_folder.is_dir() else run_folder).best
    if task != "detect" and navigator is None:
        navigator = RunFolder(runs / "navigate" / f"{name}-stack").best
    run = explain_run(
        settings,
        NamedRun(runs, name, overwrite),
        None if detector is None else NetworkOnData(detector, f"{above}/detect"),
        None if navigator is None else NetworkOnData(navigator, f"{above}/nav"),
        allow_overlap,
    )
    say(f"{run.root}: claims.json, metrics.json, *.parquet, *.png")


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
            help="Dataset of the same frames without some craters, from `perilune-render counterfactual`."
            " [default: data/<preset>/causal]"
        ),
    ] = None,
    turned: Annotated[
        str | None, typer.Option(help="Dataset of the same frames under another Sun, with all craters.")
    ] = None,
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
        typer.Option(
            help="Gate of the headline, such as B_22. [default: the gate chosen by runs/explain/<name>, else B_11]"
        ),
    ] = None,
    nav_dataset: Annotated[
        str | None, typer.Option(help="Navigation dataset with all craters, to measure the effect on poses.")
    ] = None,
    nav_counterfactual: Annotated[
        str | None, typer.Option(help="Dataset of the same descents, with all their frames, without some craters.")
    ] = None,
    navigator: Annotated[
        Path | None,
        typer.Option(help="A stack navigator's best.ckpt. [default: runs/navigate/<name>-stack/checkpoints/best.ckpt]"),
    ] = None,
    allow_overlap: AllowOverlap = False,
    overwrite: Overwrite = False,
) -> None:
    """Measure the effect of single craters on attention masks, detections and poses.

    Compares frames rendered with and without some craters; everything else is equal. Writes runs/explain/<name>-causal/
    with the tables of all effects, pictures, claims.json and metrics.json. Leaves a finished run of the same inputs
    unchanged; --overwrite replaces it.
    """
    settings = resolve(ExplainConfig, "explain", "perilune_train", preset, config, tuple(set_ or ()))
    if (nav_dataset is None) != (nav_counterfactual is None):
        raise UserError("--nav-dataset", "", "only one", "--nav-dataset and --nav-counterfactual together")
    # Importing torch and Lightning takes seconds; check the settings first.
    from perilune_train.explain.causal.causal_run import CausalInputs, PoseInputs, causal_folder, causal_run
    from perilune_train.training.begin import held
    from perilune_train.training.runs import NamedRun, RunFolder

    name = name or preset
    run_folder = run or runs / "detect" / name
    if run is None and not run_folder.is_dir():
        run_folder = shipped_run("detect")
    pose = None
    if nav_dataset is not None and nav_counterfactual is not None:
        best = navigator or runs / "navigate" / f"{name}-stack" / "checkpoints" / "best.ckpt"
        pose = PoseInputs(nav_dataset, nav_counterfactual, best)
    named = NamedRun(runs, name, overwrite)
    inputs = CausalInputs(
        dataset or f"data/{preset}/detect", counterfactual or f"data/{preset}/causal", split, turned, pose
    )
    gate = gate or _chosen_gate(runs / "explain" / name)
    with held(causal_folder(named)):
        finished_run = causal_run(settings, named, RunFolder(run_folder).best, gate, inputs, allow_overlap)
    say(f"{finished_run.root}: metrics.json, claims.json, *.parquet, *.png")


def _chosen_gate(explained: Path) -> str:
    """The gate that an explain run chose on validation frames; without such a run B_11, the paper's first gate."""
    gate = read_metrics(explained).get("detect/strongest_gate") if (explained / METRICS_FILE).is_file() else None
    return gate if isinstance(gate, str) else "B_11"
