"""One navigation run: train and evaluate the selected networks, evaluate the baselines, write tables and pictures."""

import time
from contextlib import closing
from pathlib import Path
from typing import Any

import lightning
from torch import Tensor

from perilune_shared.console.terminal import console, say
from perilune_shared.dataset.manifest import open_single
from perilune_shared.storage.store import Address
from perilune_train.data.shares import Share
from perilune_train.detect.inference.detector import check_detector
from perilune_train.models.architecture import NavigatorArchitecture, check_architecture_of
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.covariance import calibrate, stated_covariances
from perilune_train.motion.data.stream import Stream
from perilune_train.motion.data.trajectories import Trajectory, load_trajectories
from perilune_train.motion.metrics.baselines import MethodMotions, baselines
from perilune_train.motion.metrics.report import write_evaluation
from perilune_train.motion.network import Fusion, Scales, load_navigator, predict, predict_by_pairs
from perilune_train.motion.train.pose_results import check_one_area, evaluate_pose_run
from perilune_train.motion.train.task import Initial, NavigationTask
from perilune_train.records.metrics_file import Metrics
from perilune_train.records.provenance import (
    Provenance,
    check_terrain,
    protocol_of,
    read_provenance,
    training_provenance,
)
from perilune_train.training.begin import hashes_of, held, start_run, state_of
from perilune_train.training.fit import Hardware, Schedule, Wording, fit, own_share
from perilune_train.training.runs import (
    NamedRun,
    RunFolder,
    check_architecture,
    choose_device,
    is_first_process,
    load_state,
    load_weights,
)

_PREFIX = "backbone."


def navigate_run(
    settings: NavigateConfig,
    dataset_address: Address,
    named: NamedRun,
    detector: Path | None,
    allow_overlap: bool = False,
) -> list[RunFolder]:
    """Train the networks `settings.fusion`; write runs/navigate/<name> (warp) and <name>-stack (stack).

    Resumes interrupted runs with equal settings, dataset and detector, and leaves finished runs unchanged.

    `detector` is the default checkpoint for the stack network's backbone. It is used only if it exists and has the
    backbone's architecture. A checkpoint in `settings.detector` must have this architecture. Raises UserError on bad
    data, on a checkpoint of another architecture, and on a detector that was fitted to terrain of the test split;
    `allow_overlap` accepts this detector.

    Under torchrun all processes train, and the first one evaluates and writes.
    """
    console.quiet = not is_first_process()
    fusions: list[Fusion] = ["stack", "warp"] if settings.fusion == "both" else [settings.fusion]
    endings = {"warp": "", "stack": "-stack"}
    folders = {fusion: named.folder("navigate", endings[fusion]) for fusion in fusions}
    with held(*folders.values()):
        return _run(folders, settings, dataset_address, detector, named.overwrite, allow_overlap)


def _run(
    folders: dict[Fusion, RunFolder],
    settings: NavigateConfig,
    dataset_address: Address,
    detector: Path | None,
    overwrite: bool,
    allow_overlap: bool,
) -> list[RunFolder]:
    fusions = list(folders)
    backbone, source, inherited = _detector_backbone(settings, detector) if "stack" in fusions else (None, "", [])
    inputs: dict[Fusion, dict[str, str | None]] = {"warp": hashes_of({"dataset": dataset_address})}
    used = None if backbone is None else settings.detector or detector
    inputs["stack"] = inputs["warp"] | hashes_of({"detector": used})
    states = {fusion: state_of(folders[fusion], "navigate", settings, inputs[fusion], overwrite) for fusion in fusions}
    if set(states.values()) == {"finished"}:
        return list(folders.values())
    opened = open_single(dataset_address)
    if "stack" in fusions and settings.stack.target == "pose":
        check_one_area(opened)
    provenance = training_provenance(opened)
    start = _initial_checkpoint(settings) if "warp" in fusions else None
    start_terrain = [] if start is None else [read_provenance(start, Path(str(settings.init_from)))]
    terrain = {"warp": provenance.joined(start_terrain), "stack": provenance.joined(inherited)}
    # Both runs share one check, because the table of the warp run includes the metrics of stack.
    terrain_check = check_terrain(terrain["stack"].joined(start_terrain), opened, "test", allow_overlap)
    share = own_share(1, 1)
    stream = Stream(settings.stream, opened) if settings.stream is not None else None
    trajectories = load_trajectories(opened, share)
    seconds: dict[Fusion, float] = {}
    tasks: dict[Fusion, NavigationTask] = {}
    # Train all networks before evaluating any, so that the other processes do not wait for the first.
    for fusion, run in folders.items():
        if states[fusion] != "finished":
            start_run(run, "navigate", settings, inputs[fusion], states[fusion])
            resume = states[fusion] == "resume"
            if fusion == "stack":
                lightning.seed_everything(settings.seed, verbose=False)
                task = NavigationTask(settings, fusion, trajectories, share, initial=Initial(backbone))
            else:
                task = _warp_task(settings, trajectories, share, stream, start)
            task.provenance = terrain[fusion]
            tasks[fusion] = task
            seconds[fusion] = _train(run, task, resume)
    if not is_first_process():
        return list(folders.values())
    common: dict[Fusion, Metrics] = {
        fusion: {
            "train/seconds": round(spent, 1),
            "dataset/name": opened.info.name,
            "network/backbone": source if fusion == "stack" else f"from {settings.init_from or 'scratch'}",
            "dataset/protocol": protocol_of(opened.info),
            **terrain_check.metrics(),
        }
        for fusion, spent in seconds.items()
    }
    # Errors of poses and of motions are not comparable, so no table has both.
    of_motions = {fusion: run for fusion, run in folders.items() if getattr(settings, fusion).target == "motion"}
    if "stack" in tasks and "stack" not in of_motions:
        evaluate_pose_run(folders["stack"], tasks["stack"], trajectories, backbone, common["stack"])
    if of_motions:
        _evaluate_motions(of_motions, trajectories, common)
    return list(folders.values())


def _evaluate_motions(
    folders: dict[Fusion, RunFolder], trajectories: list[Trajectory], common: dict[Fusion, Metrics]
) -> None:
    """Evaluate the motion networks and the methods without a network; write tables for the runs in `common`.

    `common` has the runs that this command trained, each with its metrics that need no evaluation.
    """
    test = [trajectory for trajectory in trajectories if trajectory.split == "test"]
    classical = baselines([trajectory for trajectory in trajectories if trajectory.split == "train"], test)
    motions, covariances = classical.motions, classical.covariances
    # `stack` comes first, so that the table of the warp run, written last, has both networks.
    for fusion, run in folders.items():
        network, architecture = load_navigator(run.best, fusion)
        started = time.monotonic()
        motions = {fusion: [predict(network, architecture, trajectory) for trajectory in test], **motions}
        if fusion == "warp" and fusion in common:
            chosen_on = [trajectory for trajectory in trajectories if trajectory.split == "val"]
            calibrate(run.root, network, architecture, chosen_on)
        stated = stated_covariances(run.root, network, architecture, test)
        if stated is not None:
            covariances = {fusion: stated, **covariances}
        if fusion not in common:
            continue
        pairs = sum(trajectory.n_pairs for trajectory in test)
        details = {
            "test/pairs": pairs,
            "test/ms_per_pair": round(1e3 * (time.monotonic() - started) / pairs, 2),
            "test/ms_per_single_pair": round(1e3 * predict_by_pairs(network, architecture, test[0])[1], 2),
            "network/parameters": sum(p.numel() for p in network.parameters()),
            **common[fusion],
        }
        write_evaluation(run.root, fusion, "test", test, MethodMotions(motions, covariances), details)


def _initial_checkpoint(settings: NavigateConfig) -> dict[str, Any] | None:
    """Content of the checkpoint `navigate.init_from`. Raises UserError if its network has another architecture."""
    if settings.init_from is None:
        return None
    path, warp = Path(settings.init_from), settings.warp
    content = load_weights(path)
    expected = {"fusion": "warp", **{key: getattr(warp, key) for key in ("size_px", "width", "attention", "hidden")}}
    check_architecture(path, content["architecture"], expected)
    check_architecture_of(NavigatorArchitecture, content["architecture"], path)
    return content


def _warp_task(
    settings: NavigateConfig,
    trajectories: list[Trajectory],
    share: Share,
    stream: Stream | None,
    start: dict[str, Any] | None,
) -> NavigationTask:
    """Training of warp, from random weights or from a checkpoint."""
    lightning.seed_everything(settings.seed, verbose=False)
    if start is None:
        return NavigationTask(settings, "warp", trajectories, share, stream)
    scales = Scales(**start["architecture"]["scales"])
    task = NavigationTask(settings, "warp", trajectories, share, stream, Initial(scales=scales))
    load_state(task.network, start["state_dict"], Path(str(settings.init_from)))
    return task


def _train(run: RunFolder, task: NavigationTask, resume: bool) -> float:
    """Train one network; returns the training time in seconds."""
    settings, network_settings = task.settings, task.own
    schedule = Schedule(
        epochs=network_settings.coarse_epochs + network_settings.fine_epochs,
        monitor="val/position_rmse_vector_m",
        mode="min",
        checkpoint_minutes=settings.checkpoint_minutes,
        accumulate=network_settings.accumulate,
    )
    hardware = Hardware(
        device=choose_device(settings.device),
        # In coarse epochs some weights have no gradient.
        strategy="ddp_find_unused_parameters_true" if network_settings.coarse_epochs else "auto",
        precision=settings.precision,
    )
    rate = f"navigate.{task.fusion}.learning_rate, which is {network_settings.learning_rate:g}"
    with closing(task):
        return fit(run, task, schedule, hardware, Wording(f"train {task.fusion}", rate), resume)


def _detector_backbone(
    settings: NavigateConfig, default: Path | None
) -> tuple[dict[str, Tensor] | None, str, list[Provenance]]:
    """Weights of a detector's backbone, a text about their source, and the record of the detector's terrain.

    If no detector with the backbone's architecture exists: None, a text with the reason, and no record.
    """
    path = settings.detector or default
    if path is None or (settings.detector is None and not path.is_file()):
        reason = "from scratch: no detect run to start from"
        say(f"stack: backbone {reason}")
        return None, reason, []
    content = load_weights(path)
    expected = {
        "in_channels": settings.in_channels,
        "width": settings.stack.width,
        "attention": settings.stack.attention,
    }
    other = [key for key, value in expected.items() if content["architecture"].get(key) != value]
    if other and settings.detector is None:
        reason = f"from scratch: {path} differs in {', '.join(other)}"
        say(f"stack: backbone {reason}")
        return None, reason, []
    check_architecture(path, content["architecture"], expected)
    check_detector(content, path)
    weights = content["state_dict"].items()
    state = {key.removeprefix(_PREFIX): value for key, value in weights if key.startswith(_PREFIX)}
    stages = sum(key.startswith("downs.") and key.endswith("conv.weight") for key in state)
    wanted = settings.stack.stages
    source = f"stages 1 to {min(stages, wanted)} of {wanted} from {path}"
    say(f"stack: backbone {source}")
    return state, source, [read_provenance(content, path)]
