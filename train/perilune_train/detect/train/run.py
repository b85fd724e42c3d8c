"""One detection run: load, train, evaluate, write."""

import math
import time
from pathlib import Path

import lightning
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.errors import UserError
from perilune_shared.progress import console, progress_bar
from perilune_shared.storage.files import written_aside
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.frame_facts import facts_of
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.evaluate.evaluation import Evaluation, evaluate_detections
from perilune_train.detect.evaluate.matching import EDGE, Detections, Matches, match_split
from perilune_train.detect.evaluate.metrics import curve, figures
from perilune_train.detect.evaluate.report import write_evaluation
from perilune_train.detect.inference.scales import at_scales, detect_at_scales, multiply_adds_of_a_frame
from perilune_train.detect.train.anchors import best_possible_recall, kmeans_anchors, mean_best_iou
from perilune_train.detect.train.distill import Teacher
from perilune_train.detect.train.task import DetectTask
from perilune_train.detect.train.transfer import inherited_terrain, start_from
from perilune_train.evaluation.marks import mark_files
from perilune_train.evaluation.provenance import check_terrain, protocol_of, training_provenance
from perilune_train.models.yolo import ANCHORS_PER_SCALE, YOLOv3
from perilune_train.training import runs
from perilune_train.training.begin import hashes_of, start_run, state_of
from perilune_train.training.fit import fit, machines

_ANCHOR_STREAM = 1
WRITTEN = (
    "report.md",
    "detections.png",
    "precision_recall.png",
    "bins.png",
    "detections.parquet",
    "precision_recall.parquet",
)
"""Files that an evaluation writes in addition to metrics.json."""


def label_sizes(split: DetectSplit) -> np.ndarray:
    """Widths and heights (N, 2) in pixels of all wanted labels of a split."""
    boxes = np.concatenate([part.boxes[part.wanted] for part in split.labels])
    return boxes[:, 2:] - boxes[:, :2]


def build_network(config: DetectConfig, sizes_px: np.ndarray, where: Path) -> YOLOv3:
    """The network with anchors of these label sizes (N, 2). Raises UserError where there are no labels."""
    if len(sizes_px) == 0:
        raise UserError(where, "labels", "no visible crater in the training split", "at least one")
    count = len(config.strides) * ANCHORS_PER_SCALE
    anchors = kmeans_anchors(sizes_px, count, np.random.default_rng([config.seed, _ANCHOR_STREAM]))
    lightning.seed_everything(config.seed, verbose=False)
    shaped = torch.as_tensor(anchors).view(len(config.strides), ANCHORS_PER_SCALE, 2)
    return YOLOv3(shaped, config.in_channels, config.width, config.attention, config.strides)


def load_detector(path: Path) -> YOLOv3:
    """The network of a detect run's best.ckpt, in evaluation mode. Raises UserError on another kind of file."""
    content = runs.load_weights(path)
    architecture = content["architecture"]
    if set(architecture) != {"in_channels", "width", "attention", "strides"}:
        raise UserError(path, "architecture", sorted(architecture), "a detect run's checkpoint")
    network = YOLOv3(None, **architecture)
    runs.fill(network, content["state_dict"], path)
    return network.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


def load_teacher(path: Path, config: DetectConfig) -> Teacher:
    """The network to learn from. Raises UserError where its input channels or strides are not the student's."""
    network = load_detector(path)
    wanted = {"in_channels": config.in_channels, "strides": list(config.strides)}
    runs.check_architecture(path, runs.load_weights(path)["architecture"], wanted)
    return Teacher(network.requires_grad_(False))


def judge(split: DetectSplit, found: list[Detections], config: DetectConfig) -> Matches:
    """The detections of a split against its labels."""
    height, width = split.frames.images.shape[1:]
    return match_split(found, split.labels, (width, height), config.evaluation.match_iou, split.radius_px)


def selection_used(config: DetectConfig, split: DetectSplit) -> dict[str, float | int | str | None]:
    """What was wanted, for metrics.json: the selection's name and its thresholds; null asks for nothing."""
    used = {f"labels/{key}": value for key, value in config.labels.model_dump(exclude={"radius_px"}).items()}
    return used | {"labels/min_radius_px": split.radius_px[0], "labels/max_radius_px": split.radius_px[1]}


def write_detections(path: Path, split: DetectSplit, found: list[Detections]) -> None:
    """Table frame_id, x0_px, y0_px, x1_px, y1_px, score, one row a detection."""
    boxes = np.concatenate([part.boxes for part in found])
    names = np.repeat(split.frames.table["frame_id"].to_numpy(), [len(part.scores) for part in found])
    columns = {"frame_id": pa.array(names, pa.string())}
    columns |= {name: pa.array(boxes[:, k]) for k, name in enumerate(("x0_px", "y0_px", "x1_px", "y1_px"))}
    columns["score"] = pa.array(np.concatenate([part.scores for part in found]))
    with written_aside(path) as aside:
        pq.write_table(pa.table(columns), aside, compression="zstd")


def run_detect(
    config: DetectConfig,
    dataset_root: Path,
    runs_root: Path,
    name: str,
    overwrite: bool = False,
    allow_overlap: bool = False,
) -> runs.RunFolder:
    """Train and evaluate a detector; everything it leaves is in the returned folder.

    An interrupted run of the same settings and dataset is resumed, a finished one left as it is; `overwrite` replaces
    both. Raises UserError where its settings or dataset were others, where its last state is damaged, on a dataset,
    weights or settings that cannot be trained with, and where a network that it starts or learns from was fitted to
    terrain of the test split, unless `allow_overlap`.
    """
    console.quiet = not runs.is_first_process()
    run = runs.RunFolder(runs_root / "detect" / name)
    inputs = hashes_of({"dataset": dataset_root, "teacher": None if config.teacher is None else Path(config.teacher)})
    state = state_of(run, "detect", config, inputs, overwrite)
    if state == "finished":
        return run
    resume = state == "resume"
    dataset = open_dataset(dataset_root)
    terrain = training_provenance(dataset).joined(inherited_terrain(config, run.last if resume else None))
    terrain_check = check_terrain(terrain, dataset, "test", allow_overlap)
    device = runs.choose_device(config.device)
    bf16 = runs.choose_bf16(config.precision, device)
    scale = {"train": config.augment.scale, "val": (1.0, 1.0), "test": (1.0, 1 / EDGE)}
    splits = {split: load_split(dataset, split, config.labels, scale[split]) for split in ("train", "val", "test")}
    processes = math.prod(machines(config.devices, config.num_nodes))
    for split in ("train", "val"):
        if len(splits[split]) < processes:
            wanted = f"at least {processes}, one for each process"
            raise UserError(dataset.root, f"{split} frames", len(splits[split]), wanted)
    sizes = label_sizes(splits["train"])
    network = build_network(config, sizes, dataset.root)
    if config.init_from is not None and not resume:
        start_from(network, Path(config.init_from), config)
    teacher = None if config.teacher is None else load_teacher(Path(config.teacher), config)
    if teacher is not None:
        network.anchors.copy_(teacher.network.anchors)
    start_run(run, "detect", config, inputs, state)
    frozen_epochs = config.frozen_epochs if config.init_from is not None else 0
    if config.frozen_epochs and not frozen_epochs:
        console.print("frozen_epochs without init_from: nothing to freeze, the whole network trains from the start")
    # The anchors of a resumed run may be others, and are in its state.
    if not resume:
        console.print(told_of_anchors(network, sizes, config.anchor_ratio))
    task = DetectTask(network, config, splits["train"], splits["val"], frozen_epochs, teacher)
    task.terrain = terrain.plain()
    seconds = fit(
        run,
        task,
        label="train detector",
        epochs=config.epochs,
        monitor="val/ap50_paper",
        mode="max",
        resume=resume,
        gradient_clip=config.gradient_clip,
        precision=config.precision,
        device=config.device,
        devices=config.devices,
        num_nodes=config.num_nodes,
        strategy="ddp_find_unused_parameters_true" if config.strategy == "auto" and frozen_epochs else config.strategy,
        checkpoint_minutes=config.checkpoint_minutes,
    )
    if not runs.is_first_process():
        return run
    anchors = anchor_sizes(network)
    metrics: dict[str, float | int | str | None] = {
        "train/seconds": round(seconds, 1),
        "train/epochs": config.epochs,
        "train/images_per_s": round(task.images_seen / seconds, 2),
        "anchors/best_possible_recall": best_possible_recall(sizes, anchors, config.anchor_ratio),
        "anchors/mean_best_iou": mean_best_iou(sizes, anchors),
        "parameters": sum(p.numel() for p in network.parameters()),
        "multiply_adds": multiply_adds_of_a_frame(network, config, *splits["test"].frames.images.shape[1:]),
    }
    metrics |= selection_used(config, splits["test"])
    metrics |= told_of(dataset, "test", config) | evaluate(run, config, dataset, splits, device, bf16)
    mark_files(run.root, WRITTEN, terrain_check.mark)
    metrics |= terrain_check.metrics()
    runs.write_metrics(run, metrics)
    console.print(f"{run.root}: metrics.json, report.md, detections.png, precision_recall.png, bins.png")
    return run


def anchor_sizes(network: YOLOv3) -> np.ndarray:
    """Widths and heights (N, 2) in pixels of a network's anchors."""
    return network.anchors.flatten(0, 1).double().cpu().numpy()


def told_of_anchors(network: YOLOv3, sizes_px: np.ndarray, ratio: float) -> str:
    """How well a network's anchors suit labels of these sizes (N, 2): recall that training can reach at best."""
    recall = best_possible_recall(sizes_px, anchor_sizes(network), ratio)
    return (
        f"anchors: best possible recall {recall:.4f}, the share of the training labels that have one within a factor "
        f"of {ratio:g} in width and height"
    )


def told_of(dataset: Dataset, split: str, config: DetectConfig) -> dict[str, float | int | str | None]:
    """What was judged and how, for metrics.json."""
    return {
        "dataset/name": dataset.info.name,
        "dataset/split_by": dataset.info.split_by,
        "dataset/protocol": protocol_of(dataset.info),
        "evaluation/split": split,
        "evaluation/scales": " ".join(f"{factor:g}" for factor in config.evaluation.scales),
    }


def detect_split(
    network: YOLOv3, split: DetectSplit, name: str, config: DetectConfig, device: str, bf16: bool
) -> tuple[list[Detections], float]:
    """Detections of all frames of a split, and frames a second."""
    with progress_bar() as progress:
        bar = progress.add_task(f"detect {name}", total=len(split), unit="frames", note="")
        started = time.perf_counter()
        network = network.to(device).eval()
        found: list[Detections] = []
        for start in range(0, len(split), config.batch_size):
            frames = split.frames.images[start : start + config.batch_size]
            found += detect_at_scales(network, frames, config, device, bf16)
            progress.advance(bar, len(frames))
        return found, len(split) / (time.perf_counter() - started)


def judge_in_full(split: DetectSplit, found: list[Detections], config: DetectConfig, threshold: float) -> Evaluation:
    """Everything that is told of a split's detections."""
    return evaluate_detections(
        found,
        split.labels,
        facts_of(split.frames),
        threshold,
        radius_px=split.radius_px,
        match_iou=config.evaluation.match_iou,
        seed=config.seed,
    )


def about(dataset: Dataset, split: str, config: DetectConfig, protocol: str, run: str, chosen_on: str) -> list[str]:
    """What was judged and how, for the head of a report."""
    settings = config.evaluation
    thresholds = config.labels.model_dump(exclude={"selection"}, exclude_none=True)
    return [
        f"run `{run}`, best weights; dataset `{dataset.info.name}`, split {split}; protocol: {protocol}",
        f"wanted: selection `{config.labels.selection}` ({', '.join(f'{k} {v}' for k, v in thresholds.items())})",
        f"threshold {chosen_on}",
        f"detections below a score of {settings.min_score:g} are dropped, suppression at IoU {settings.nms_iou:g}, "
        f"at most {settings.max_detections} are kept in a frame; frames looked at {at_scales(settings.scales)}",
    ]


def evaluate(
    run: runs.RunFolder,
    config: DetectConfig,
    dataset: Dataset,
    splits: dict[str, DetectSplit],
    device: str,
    bf16: bool,
) -> dict[str, float | int | str | None]:
    """Judge the best weights on val and test, write tables and pictures; the threshold is chosen on val alone."""
    network = load_detector(run.best)
    found_val, _ = detect_split(network, splits["val"], "val", config, device, bf16)
    found, rate = detect_split(network, splits["test"], "test", config, device, bf16)
    matches = judge(splits["val"], found_val, config)
    threshold, chosen_as = curve(matches).operating_threshold(config.evaluation.min_precision)
    evaluation = judge_in_full(splits["test"], found, config, threshold)
    write_detections(run.root / "detections.parquet", splits["test"], found)
    told = about(dataset, "test", config, protocol_of(dataset.info), run.root.name, f"{chosen_as} on val")
    told.append(told_of_anchors(network, label_sizes(splits["train"]), config.anchor_ratio))
    write_evaluation(run.root, evaluation, list(splits["test"].frames.images), told)
    metrics: dict[str, float | int | str | None] = {
        f"val/{key}": value for key, value in figures(matches, threshold).items()
    }
    metrics |= {f"test/{key}": value for key, value in evaluation.figures().items()}
    return metrics | {"test/images_per_s": round(rate, 2)}
