"""One detection run: load, train, evaluate, write."""

import time
from pathlib import Path

import lightning
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from perilune_shared.errors import UserError
from perilune_shared.files import written_aside
from perilune_shared.manifest import open_dataset
from perilune_shared.progress import console, progress_bar
from perilune_train import runs
from perilune_train.detect.anchors import best_possible_recall, kmeans_anchors, mean_best_iou
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data import DetectSplit, load_split
from perilune_train.detect.figures import draw_curve, draw_detections
from perilune_train.detect.metrics import Detections, Matches, curve, figures, match_split
from perilune_train.detect.task import DetectTask, detect_frames
from perilune_train.detect.transfer import start_from_darknet
from perilune_train.models.darknet_weights import is_darknet
from perilune_train.models.yolo import ANCHORS_PER_SCALE, YOLOv3

_ANCHOR_STREAM = 1


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


def start_backbone(network: YOLOv3, path: Path, config: DetectConfig) -> None:
    """Give the network the backbone of an earlier detect run, or what a Darknet file has for it (detect/transfer.py).

    Gates that the other lacks stay as they are.
    """
    if is_darknet(path):
        start_from_darknet(network, path, config)
        return
    content = runs.load_weights(path)
    wanted = {"in_channels": config.in_channels, "width": config.width}
    runs.check_architecture(path, content["architecture"], wanted)
    own = network.backbone.state_dict()
    prefix = "backbone."
    state = {key.removeprefix(prefix): value for key, value in content["state_dict"].items() if key.startswith(prefix)}
    if content["architecture"]["attention"] != config.attention:
        state = {key: value for key, value in state.items() if not key.startswith("attentions.")}
        state |= {key: value for key, value in own.items() if key.startswith("attentions.")}
    runs.fill(network.backbone, state, path)


def load_detector(path: Path) -> YOLOv3:
    """The network of a detect run's best.ckpt, in evaluation mode. Raises UserError on another kind of file."""
    content = runs.load_weights(path)
    architecture = content["architecture"]
    if set(architecture) != {"in_channels", "width", "attention", "strides"}:
        raise UserError(path, "architecture", sorted(architecture), "a detect run's checkpoint")
    network = YOLOv3(None, **architecture)
    runs.fill(network, content["state_dict"], path)
    return network.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


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
    config: DetectConfig, dataset_root: Path, runs_root: Path, name: str, resume: bool = False
) -> runs.RunFolder:
    """Train and evaluate a detector; everything it leaves is in the returned folder."""
    dataset = open_dataset(dataset_root)
    device = runs.choose_device(config.device)
    bf16 = runs.choose_bf16(config.precision, device)
    enlarged = {"train": max(config.augment.scale[1], 1.0)}
    splits = {
        split: load_split(dataset, split, config.labels, enlarged.get(split, 1.0)) for split in ("train", "val", "test")
    }
    sizes = label_sizes(splits["train"])
    network = build_network(config, sizes, dataset.root)
    if config.init_from is not None:
        start_backbone(network, Path(config.init_from), config)
    run = runs.start_run(runs_root, "detect", name, config, resume)
    frozen_epochs = config.frozen_epochs if config.init_from is not None else 0
    if config.frozen_epochs and not frozen_epochs:
        console.print("frozen_epochs without init_from: nothing to freeze, the whole network trains from the start")
    task = DetectTask(network, config, splits["train"], splits["val"], frozen_epochs)
    started = time.perf_counter()
    runs.fit(
        run,
        task,
        label="train detector",
        epochs=config.epochs,
        monitor="val/ap50",
        mode="max",
        resume=resume,
        precision=config.precision,
        device=config.device,
    )
    seconds = time.perf_counter() - started
    anchors = network.anchors.flatten(0, 1).double().cpu().numpy()
    metrics: dict[str, float | int | str | None] = {
        "train/seconds": round(seconds, 1),
        "train/epochs": config.epochs,
        "train/images_per_s": round(task.images_seen / seconds, 2),
        "anchors/best_possible_recall": best_possible_recall(sizes, anchors, config.anchor_ratio),
        "anchors/mean_best_iou": mean_best_iou(sizes, anchors),
        "parameters": sum(p.numel() for p in network.parameters()),
    }
    metrics |= selection_used(config, splits["test"])
    metrics |= evaluate(run, config, splits, device, bf16)
    runs.write_metrics(run, metrics)
    return run


def evaluate(
    run: runs.RunFolder, config: DetectConfig, splits: dict[str, DetectSplit], device: str, bf16: bool
) -> dict[str, float]:
    """Judge the best weights on val and test, write table and pictures; the threshold is chosen on val alone."""
    network = load_detector(run.best)
    found: dict[str, list[Detections]] = {}
    with progress_bar() as progress:
        for split in ("val", "test"):
            bar = progress.add_task(f"detect {split}", total=len(splits[split]), unit="frames", note="")
            started = time.perf_counter()
            found[split] = detect_frames(
                network, splits[split].frames, config, device, bf16, lambda n, bar=bar: progress.advance(bar, n)
            )
            rate = len(splits[split]) / (time.perf_counter() - started)
    matches = {split: judge(splits[split], found[split], config) for split in found}
    threshold = curve(matches["val"]).best_threshold()
    metrics = {f"{split}/{key}": value for split in found for key, value in figures(matches[split], threshold).items()}
    metrics |= {
        "test/threshold": threshold,
        "test/images_per_s": round(rate, 2),
        "test/frames": len(splits["test"]),
        "test/labels": len(matches["test"].wanted_radius_px),
    }
    write_detections(run.root / "detections.parquet", splits["test"], found["test"])
    draw_curve(
        {"usual": curve(matches["test"]), "strict": curve(matches["test"].strict())}, run.root / "precision_recall.png"
    )
    draw_detections(splits["test"], found["test"], threshold, run.root / "detections.png")
    return metrics
