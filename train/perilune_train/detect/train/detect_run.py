"""One training run of the detector: load, train, evaluate, write."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import lightning
import numpy as np
import torch
from numpy.typing import NDArray

from perilune_shared.console.terminal import console, say, say_page
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address
from perilune_train.data.shares import ALONE
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.fresh import FreshFrames, FreshServer
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.data.streamed import open_streamed
from perilune_train.detect.evaluate.matching import EDGE
from perilune_train.detect.evaluate.metrics import figures
from perilune_train.detect.evaluate.report import write_evaluation
from perilune_train.detect.evaluate.split_evaluation import (
    WRITTEN,
    dataset_entries,
    evaluate_split,
    match_detections,
    novel_entries,
    report_head,
    score_meaning,
    selection_entries,
    write_detections,
)
from perilune_train.detect.finished_run import calibration_in
from perilune_train.detect.inference.detector import load_detector, open_detector
from perilune_train.detect.inference.scales import detect_split, multiply_adds_of_a_frame
from perilune_train.detect.novelty import TrainingFeatures, write_training_features
from perilune_train.detect.train.anchors import best_possible_recall, kmeans_anchors, mean_best_iou
from perilune_train.detect.train.distill import Teacher
from perilune_train.detect.train.task import DetectTask
from perilune_train.detect.train.threshold import calibration_entries, detect_validation
from perilune_train.detect.train.training_features import training_features
from perilune_train.detect.train.transfer import inherited_terrain, start_from
from perilune_train.models.yolo import ANCHORS_PER_SCALE, YOLOv3
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import Metrics, write_metrics
from perilune_train.records.provenance import check_terrain, protocol_of, training_provenance
from perilune_train.shipped.models import weights_file
from perilune_train.training import runs
from perilune_train.training.begin import hashes_of, held, start_run, state_of
from perilune_train.training.fit import Hardware, Schedule, Wording, fit, own_share

_ANCHOR_STREAM = 1


def run_detect(
    config: DetectConfig,
    dataset_address: Address,
    runs_root: Path,
    name: str,
    overwrite: bool = False,
    allow_overlap: bool = False,
) -> runs.RunFolder:
    """Train and evaluate a detector; returns the folder with all output.

    Resumes an interrupted run with equal settings and dataset, and leaves a finished run unchanged; `overwrite`
    replaces either run.

    Raises UserError if the existing run has other settings or another dataset; if its last state is damaged; if the
    dataset or the initial weights are unsuitable; or if the network of the initial weights or the teacher was fitted to
    terrain of the test split (unless `allow_overlap`).
    """
    console.quiet = not runs.is_first_process()
    run = runs.RunFolder(runs_root / "detect" / name)
    with held(run):
        return _run(run, config, dataset_address, overwrite, allow_overlap)


def _run(
    run: runs.RunFolder, config: DetectConfig, dataset_address: Address, overwrite: bool, allow_overlap: bool
) -> runs.RunFolder:
    inputs = hashes_of(
        {"dataset": dataset_address, "teacher": None if config.teacher is None else Path(config.teacher)}
    )
    state = state_of(run, "detect", config, inputs, overwrite)
    if state == "finished":
        return run
    resume = state == "resume"
    dataset = open_single(dataset_address)
    terrain = training_provenance(dataset).joined(inherited_terrain(config, run.last if resume else None))
    terrain_check = check_terrain(terrain, dataset, "test", allow_overlap)
    device = runs.choose_device(config.device)
    scale = {"train": config.augment.scale, "val": (1.0, 1.0), "test": (1.0, 1 / EDGE)}
    share = own_share(config.devices, config.num_nodes)
    server = FreshServer(config.fresh, dataset) if config.fresh is not None else None
    in_memory = ("val",) if config.stream else ("train", "val")
    splits = {name: load_split(dataset, name, config.labels, scale[name], share) for name in in_memory}
    train = open_streamed(dataset, config, share) if config.stream else splits["train"]
    if runs.is_first_process():
        splits["test"] = load_split(dataset, "test", config.labels, scale["test"])
    sizes = train.label_sizes_px
    network = build_network(config, sizes, dataset.store)
    if config.init_from is not None and not resume:
        start_from(network, weights_file(config.init_from), config)
    teacher = None if config.teacher is None else load_teacher(Path(config.teacher), config)
    if teacher is not None:
        network.anchors.copy_(teacher.network.anchors)
    start_run(run, "detect", config, inputs, state)
    frozen_epochs = config.frozen_epochs if config.init_from is not None else 0
    if config.frozen_epochs and not frozen_epochs:
        say("detect.frozen_epochs is ignored without detect.init_from: the whole network is trained from the start")
    # A resumed run later loads anchors from its state, which may differ from these anchors.
    if not resume:
        say_page(anchor_report(network, sizes, config.anchor_ratio))
    used = train if server is None else FreshFrames(splits["train"], config, dataset, server)
    task = DetectTask(network, config, used, splits["val"], frozen_epochs, teacher)
    task.provenance = terrain
    schedule = Schedule(
        epochs=config.epochs,
        # AP does not depend on the ellipses: keep the last weights.
        monitor="val/steps" if config.trained == "ellipses" else "val/ap50_paper",
        mode="max",
        validate_every=config.validate_every,
        checkpoint_minutes=config.checkpoint_minutes,
        gradient_clip=config.gradient_clip,
    )
    # Frozen weights have no gradient, and plain DDP would wait for their gradients.
    strategy = "ddp_find_unused_parameters_true" if config.strategy == "auto" and frozen_epochs else config.strategy
    hardware = Hardware(device, config.devices, config.num_nodes, strategy, config.precision)
    wording = Wording("train detector", f"detect.learning_rate, which is {config.learning_rate:g}")
    with closing(task):
        seconds = fit(run, task, schedule, hardware, wording, resume)
    if not runs.is_first_process():
        return run
    if share != ALONE:
        splits["val"] = load_split(dataset, "val", config.labels, scale["val"])
    anchors = anchor_sizes(network)
    metrics: Metrics = {
        "train/seconds": round(seconds, 1),
        "train/epochs": config.epochs,
        "train/start": config.init_from or "random weights",
        "train/images_per_s": round(task.images_seen / seconds, 2),
        "anchors/best_possible_recall": best_possible_recall(sizes, anchors, config.anchor_ratio),
        "anchors/mean_best_iou": mean_best_iou(sizes, anchors),
        "parameters": sum(p.numel() for p in network.parameters()),
        "multiply_adds": multiply_adds_of_a_frame(network, config, *splits["test"].frames.images.shape[1:]),
    }
    metrics |= selection_entries(config, splits["test"])
    features = training_features(open_detector(run.best, config), dataset)
    metrics |= write_training_features(run.root, features)
    metrics |= dataset_entries(dataset, "test", config) | evaluate(run, config, dataset, splits, sizes, features)
    mark_files(run.root, WRITTEN, terrain_check.mark)
    metrics |= terrain_check.metrics()
    write_metrics(run.root, metrics)
    say(f"{run.root}: metrics.json, report.md, detections.png, precision_recall.png, reliability.png, bins.png")
    return run


def evaluate(
    run: runs.RunFolder,
    config: DetectConfig,
    dataset: Dataset,
    splits: dict[str, DetectSplit],
    sizes_px: NDArray[np.float64],
    features: TrainingFeatures | None,
) -> Metrics:
    """Evaluate the best weights on val and test; write tables and pictures.

    The threshold is chosen, and the calibration of the scores is fitted, on val only. `sizes_px` (S, 2) are the sizes
    of the training labels; `features` are the features of the training frames.
    """
    detector = open_detector(run.best, config)
    raw_val, _ = detect_split(detector, splits["val"], "val")
    validation = detect_validation(detector, splits["val"], raw_val)
    threshold, chosen_on = validation.threshold(config.evaluation)
    entries = calibration_entries(validation, config.evaluation, threshold)
    calibration = calibration_in(entries, run.metrics)
    if calibration is not None:
        threshold = calibration.probability(threshold)
    detector = replace(detector, calibration=calibration, training_features=features)
    found_val = [detector.calibrated(of_frame) for of_frame in raw_val]
    found_test, rate = detect_split(detector, splits["test"], "test")
    matches = match_detections(splits["val"], found_val, config)
    evaluation = evaluate_split(splits["test"], found_test, config, threshold)
    write_detections(run.root / "detections.parquet", splits["test"], found_test)
    about = report_head(dataset, "test", config, protocol_of(dataset.info), run.root.name, chosen_on)
    about.append(score_meaning(calibration))
    about.append(anchor_report(detector.network, sizes_px, config.anchor_ratio))
    write_evaluation(run.root, evaluation, list(splits["test"].frames.images), about)
    metrics: Metrics = {f"val/{key}": value for key, value in figures(matches, threshold).items()}
    metrics |= {f"test/{key}": value for key, value in evaluation.figures().items()}
    return metrics | entries | novel_entries(found_test, "test/") | {"test/images_per_s": round(rate, 2)}


def build_network(config: DetectConfig, sizes_px: np.ndarray, where: object) -> YOLOv3:
    """Build the network with anchors for label sizes (N, 2), pixels. Raises UserError without labels."""
    if len(sizes_px) == 0:
        raise UserError(where, "labels", "no visible crater in the training split", "at least one")
    count = len(config.strides) * ANCHORS_PER_SCALE
    rng = np.random.default_rng([config.seed, _ANCHOR_STREAM])
    anchors = kmeans_anchors(sizes_px, count, rng, plain=config.anchor_sampling == "plain")
    lightning.seed_everything(config.seed, verbose=False)
    shaped = torch.as_tensor(anchors).view(len(config.strides), ANCHORS_PER_SCALE, 2)
    return YOLOv3(shaped, config.in_channels, config.width, config.attention, config.strides, config.ellipses)


def load_teacher(path: Path, config: DetectConfig) -> Teacher:
    """Load the teacher network. Raises UserError if in_channels or strides differ from the student's."""
    network = load_detector(path)
    expected = {"in_channels": config.in_channels, "strides": list(config.strides)}
    runs.check_architecture(path, runs.load_weights(path)["architecture"], expected)
    return Teacher(network.requires_grad_(False))


def anchor_sizes(network: YOLOv3) -> np.ndarray:
    """Widths and heights (N, 2) in pixels of a network's anchors."""
    return network.anchors.flatten(0, 1).double().cpu().numpy()


def anchor_report(network: YOLOv3, sizes_px: np.ndarray, ratio: float) -> str:
    """Text that states how well anchors fit label sizes (N, 2), which limits the recall of training."""
    recall = best_possible_recall(sizes_px, anchor_sizes(network), ratio)
    return (
        f"anchors: best possible recall {recall:.4f}, the fraction of training labels with an anchor within a factor "
        f"of {ratio:g} in width and height"
    )
