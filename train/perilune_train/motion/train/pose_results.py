"""Evaluate a run that was trained to estimate the pose in O_L, together with its floors."""

import time
from typing import Any

import torch
from torch import Tensor

from perilune_shared.console.terminal import say_page
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_train.motion.data.trajectories import Pose, Trajectory
from perilune_train.motion.metrics.floors import Known, mean_poses, ridge_poses
from perilune_train.motion.metrics.report import write_pose_evaluation
from perilune_train.motion.network import build, load_navigator
from perilune_train.motion.pose import predict_pose, predict_pose_by_pairs
from perilune_train.motion.train.stored import stored_features
from perilune_train.motion.train.task import NavigationTask
from perilune_train.records.metrics_file import Metrics
from perilune_train.training.runs import RunFolder, choose_bf16, choose_device


def check_one_area(dataset: Dataset) -> None:
    """Raise UserError unless the dataset has all its trajectories over one scene."""
    scenes = {str(row["scene_id"]) for row in dataset.table("trajectories").to_pylist()}
    if len(scenes) != 1:
        expected = "1, the landing area of navigate.stack.target=pose; render with dataset.nav.n_scenes=1"
        raise UserError(dataset.store, "scenes", len(scenes), f"{expected} and split_by=trajectory")


def evaluate_pose_run(
    run: RunFolder,
    task: NavigationTask,
    trajectories: list[Trajectory],
    backbone: dict[str, Tensor] | None,
    details: Metrics,
) -> None:
    """Evaluate the best weights of a run on the test trajectories, write the tables, and print the page."""
    device = torch.device(choose_device(task.settings.device))
    test = [trajectory for trajectory in trajectories if trajectory.split == "test"]
    network, architecture = load_navigator(run.best, "stack")
    network.to(device)
    started = time.monotonic()
    poses: dict[str, list[Pose]] = {"stack": [predict_pose(network, architecture, trajectory) for trajectory in test]}
    pairs, seconds = sum(trajectory.n_pairs for trajectory in test), time.monotonic() - started
    poses |= mean_poses([trajectory for trajectory in trajectories if trajectory.split == "train"], test)
    if task.stores and backbone is not None:
        poses["ridge"] = _ridge(task, backbone, [trajectory.shrunk(task.own.size_px) for trajectory in test], device)
    _, seconds_by_pairs = predict_pose_by_pairs(network.cpu(), architecture, test[0])
    measured: Metrics = {
        "test/pairs": pairs,
        "test/ms_per_pair": round(1e3 * seconds / pairs, 2),
        "test/ms_per_single_pair": round(1e3 * seconds_by_pairs, 2),
        "network/parameters": sum(p.numel() for p in network.parameters()),
    }
    say_page(write_pose_evaluation(run.root, "stack", "test", test, poses, measured | details))


def _ridge(
    task: NavigationTask, backbone: dict[str, Tensor], test: list[Trajectory], device: torch.device
) -> list[Pose]:
    """Poses by ridge regression on the features of the detector's backbone before navigation training."""
    frozen: Any = build(task.architecture)
    frozen.backbone.load_state_dict(backbone, strict=False)
    # Scale features as the coarse stage did when it stored them.
    for name in ("feature_mean", "feature_spread"):
        getattr(frozen, name).copy_(getattr(task.network, name))
    frozen.to(device, memory_format=torch.channels_last)
    bf16 = choose_bf16(task.settings.precision, device.type)

    def features(some_trajectories: list[Trajectory]) -> list[Array]:
        return [
            frozen.scaled(features).cpu().numpy()
            for features in stored_features(frozen, some_trajectories, device, bf16)
        ]

    numbers = task.share.of(len(task.training_trajectories))
    training = [task.training_trajectories[number] for number in numbers]
    validation = [task.validation_trajectories[number] for number in task.validated]
    known = {}
    for split, split_trajectories in (("train", training), ("val", validation)):
        # The features of `views` come after the features of the trajectories.
        stored = [
            split_features[: sum(t.n_pairs for t in split_trajectories)].cpu().numpy()
            for split_features in task.stored.get(split, [])
        ]
        known[split] = Known(split_trajectories, stored or features(split_trajectories))
    return ridge_poses(known["train"], known["val"], features(test))
