"""Evaluate a finished navigation run on a split of any dataset."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from perilune_shared.console.terminal import progress_bar, say_page
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_train.motion.covariance import stated_covariances
from perilune_train.motion.data.trajectories import Motion, Pose, Trajectory, load_split
from perilune_train.motion.metrics.baselines import MethodMotions, baselines
from perilune_train.motion.metrics.floors import constant_pose
from perilune_train.motion.metrics.report import write_evaluation, write_pose_evaluation
from perilune_train.motion.network import Fusion, Scales, load_navigator, predict, predict_by_pairs, target_of
from perilune_train.motion.pose import predict_pose, predict_pose_by_pairs
from perilune_train.records.metrics_file import Metrics
from perilune_train.records.provenance import (
    EvaluatedSplit,
    Provenance,
    check_terrain,
    protocol_of,
    read_provenance,
    split_terrain,
)
from perilune_train.training.runs import RunFolder, load_weights


def evaluate_navigator(run: Path, evaluated: EvaluatedSplit, out: Path) -> Path:
    """Evaluate a run's best weights, the classical methods and the nominal motion on a split; returns `out`.

    Raises UserError if `run` is no navigation run, if `out` is the run's own folder, or on test terrain that the
    network was fitted to, unless that is accepted.
    """
    if out.resolve() == run.resolve():
        expected = "another folder; a run keeps the metrics of its training"
        raise UserError(out, "--out", "the run's own folder", expected)
    best = RunFolder(run).best
    content = load_weights(best)
    fusion = fusion_of(best, content["architecture"])
    dataset, split = open_single(evaluated.dataset), evaluated.split
    terrain_check = check_terrain(read_provenance(content, best), dataset, split, evaluated.allow_overlap)
    trajectories = load_split(dataset, split)
    network, architecture = load_navigator(best, fusion)
    if target_of(architecture) == "pose":
        _check_area(best, read_provenance(content, best), dataset, split)
        named: Metrics = {"dataset/name": dataset.info.name, "dataset/protocol": protocol_of(dataset.info)}
        _evaluate_pose(network, architecture, split, trajectories, out, named | terrain_check.metrics())
        return out
    found, seconds = _timed(predict, network, architecture, trajectories)
    pairs = sum(trajectory.n_pairs for trajectory in trajectories)
    details = {
        f"{split}/pairs": pairs,
        f"{split}/ms_per_pair": round(1e3 * seconds / pairs, 2),
        f"{split}/ms_per_single_pair": round(1e3 * predict_by_pairs(network, architecture, trajectories[0])[1], 2),
        "network/parameters": sum(p.numel() for p in network.parameters()),
        "dataset/name": dataset.info.name,
        "dataset/protocol": protocol_of(dataset.info),
        **terrain_check.metrics(),
    }
    # Mean motions are those of the training set, which this dataset may not have.
    classical = baselines([], trajectories)
    motions, covariances = {fusion: found, **classical.motions}, classical.covariances
    stated = stated_covariances(run, network, architecture, trajectories)
    if stated is not None:
        covariances = {fusion: stated, **covariances}
    write_evaluation(out, fusion, split, trajectories, MethodMotions(motions, covariances), details)
    return out


def _check_area(path: Path, known: Provenance, dataset: Dataset, split: str) -> None:
    """Raise UserError unless a split is over the landing area that a pose network was trained on."""
    trained = {use.sha256 for use in known.uses if use.use == "trained"}
    if trained and not {use.sha256 for use in split_terrain(dataset, split, "tested")} <= trained:
        expected = f"the landing area of the training of {path}, which estimates poses over it only"
        raise UserError(dataset.store, "terrain", "another one", expected)


def _evaluate_pose(
    network: Any, architecture: dict[str, Any], split: str, trajectories: list[Trajectory], out: Path, details: Metrics
) -> None:
    """Evaluate a pose network beside the mean pose of its training, the only floor that its checkpoint has."""
    scales = Scales(**architecture["scales"])
    poses, seconds = _timed(predict_pose, network, architecture, trajectories)
    mean = np.array(scales.mean_m), np.array(scales.mean_rotation)
    pairs = sum(trajectory.n_pairs for trajectory in trajectories)
    _, by_pairs = predict_pose_by_pairs(network, architecture, trajectories[0])
    own: Metrics = {
        f"{split}/pairs": pairs,
        f"{split}/ms_per_pair": round(1e3 * seconds / pairs, 2),
        f"{split}/ms_per_single_pair": round(1e3 * by_pairs, 2),
        "network/parameters": sum(p.numel() for p in network.parameters()),
    }
    methods = {"stack": poses, "mean_pose": [constant_pose(*mean, one.n_pairs) for one in trajectories]}
    page = write_pose_evaluation(out, "stack", split, trajectories, methods, own | details)
    say_page(page)


def fusion_of(path: Path, architecture: dict[str, Any]) -> Fusion:
    """Which network a checkpoint holds. Raises UserError if it is no navigator's."""
    fusion = architecture.get("fusion")
    if fusion not in ("warp", "stack"):
        raise UserError(path, "architecture", sorted(map(str, architecture)), "a navigate run's checkpoint")
    return fusion


def _timed(
    predicted: Callable[[Any, dict[str, Any], Trajectory], Motion | Pose],
    network: Any,
    architecture: dict[str, Any],
    trajectories: list[Trajectory],
) -> tuple[list[Motion | Pose], float]:
    """Motions or poses of all trajectories, and seconds."""
    started = time.monotonic()
    with progress_bar() as progress:
        task = progress.add_task("evaluate", total=len(trajectories), unit="trajectories", note="")
        found = []
        for trajectory in trajectories:
            found.append(predicted(network, architecture, trajectory))
            progress.advance(task)
    return found, time.monotonic() - started
