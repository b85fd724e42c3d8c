"""Compare features and loss of four ways to start from a pretrained, frozen backbone.

A plain detector (no attention) is trained from scratch. Its backbone then initialises networks with attention. The
backbone weights stay frozen while gates, neck and heads are trained. Neck and heads start at random, as from
darknet53.conv.74.

    frozen       plain CBAM, weights and batch statistics frozen
    adapt        plain CBAM, weights frozen, batch statistics adapt
    recalibrate  plain CBAM, batch statistics recomputed over the training frames first, then frozen
    identity     CBAM whose gates start at 1, weights and batch statistics frozen

Prints for each: the cosine of the features after each stage to those of the plain backbone and the ratio of their RMS
values, both before training; the mean training loss of the last 20 steps; the validation loss in evaluation
mode. Writes runs/bench/transfer.json.
"""

import argparse
import itertools
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.figures import write_figures
from perilune_shared.dataset.manifest import open_dataset
from perilune_train.config import Attention
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.batches import Batch, evaluation_loader, network_input, training_loader
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.train.detect_run import build_network
from perilune_train.detect.train.loss import detection_loss
from perilune_train.detect.train.task import learning_rate_factor
from perilune_train.models.yolo import YOLOv3

CHOICES: dict[str, Attention] = {
    "frozen": "cbam",
    "adapt": "cbam",
    "recalibrate": "cbam",
    "identity": "cbam_identity",
}
_LAST = 20


def batches(split: DetectSplit, config: DetectConfig, anchors: Tensor) -> Iterator[Batch]:
    """Network input and assignments of one epoch after another, without end."""
    loaded: Any = training_loader(split, config, anchors)
    for epoch in itertools.count():
        loaded.batch_sampler.set_epoch(epoch)
        for grey, targets in loaded:
            yield network_input(grey, config.in_channels), targets


def loss_of(network: YOLOv3, batch: Batch, config: DetectConfig) -> Tensor:
    """The detector's training loss."""
    images, targets = batch
    box, confidence = detection_loss(network(images), targets, network.anchors, network.strides, config.loss)
    return config.loss.lambda_iou * box + config.loss.lambda_obj * confidence


def train(network: YOLOv3, split: DetectSplit, config: DetectConfig, steps: int) -> list[float]:
    """Train for `steps` steps and return the loss of each; keeps frozen parameters and the modes of modules."""
    learnt = [p for p in network.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(learnt, lr=config.learning_rate, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda s: learning_rate_factor(s, 20, steps))
    losses = []
    for batch in itertools.islice(batches(split, config, network.anchors), steps):
        loss = loss_of(network, batch, config)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(learnt, config.gradient_clip)
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
    return losses


@torch.no_grad()
def recalibrate(network: YOLOv3, split: DetectSplit, config: DetectConfig) -> None:
    """Replace the backbone's batch statistics by the mean of those of one epoch's batches."""
    norms = [module for module in network.backbone.modules() if isinstance(module, nn.BatchNorm2d)]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None
    network.backbone.train()
    for grey, _ in training_loader(split, config, network.anchors):
        network.backbone(network_input(grey, config.in_channels))
    for norm in norms:
        norm.momentum = 0.1


@torch.no_grad()
def similarity(network: YOLOv3, plain: YOLOv3, images: Tensor) -> dict[str, list[float]]:
    """Cosine of the features to those of the plain backbone and ratio of their RMS, for each stage."""
    expected = plain.backbone(images)
    kept = {key: value.clone() for key, value in network.state_dict().items()}
    found = network.backbone(images)
    network.load_state_dict(kept)
    cosine = nn.functional.cosine_similarity
    return {
        "cosine": [float(cosine(a.flatten(), b.flatten(), dim=0)) for a, b in zip(found, expected, strict=True)],
        "size": [float(a.norm() / b.norm()) for a, b in zip(found, expected, strict=True)],
    }


def compare(train_split: DetectSplit, val_split: DetectSplit, config: DetectConfig, steps: int, before: int) -> dict:
    """Features and losses of every choice; all start from the same plain detector."""
    sizes = train_split.label_sizes_px
    plain = build_network(config.model_copy(update={"attention": "none"}), sizes, Path())
    train(plain.train(), train_split, config, before)
    plain.eval()
    backbone = {key: value for key, value in plain.state_dict().items() if key.startswith("backbone.")}
    val = [
        (network_input(grey, config.in_channels), targets)
        for grey, targets in evaluation_loader(val_split, config, plain.anchors)
    ]
    results = {}
    for choice, attention in CHOICES.items():
        network = build_network(config.model_copy(update={"attention": attention}), sizes, Path())
        network.load_state_dict({**network.state_dict(), **backbone})
        if choice == "recalibrate":
            recalibrate(network, train_split, config)
        network.train()
        parts = (network.backbone.stem, network.backbone.downs, network.backbone.units)
        for part in parts:
            part.requires_grad_(False)
            part.train(choice == "adapt")
        similar = similarity(network, plain, val[0][0])
        losses = train(network, train_split, config, steps)
        network.eval()
        with torch.no_grad():
            val_loss = statistics.fmean(float(loss_of(network, batch, config)) for batch in val)
        results[choice] = {**similar, "loss": statistics.fmean(losses[-_LAST:]), "val_loss": val_loss}
    return results


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, required=True)
    parser.add_argument("--width", type=float, default=0.25)
    parser.add_argument("--steps", type=int, default=200, help="steps with the frozen backbone")
    parser.add_argument("--before", type=int, default=400, help="steps of the plain detector")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("runs/bench/transfer.json"))
    given = parser.parse_args()
    config = DetectConfig(width=given.width, in_channels=1, strides=(4, 8, 16), batch_size=4, learning_rate=2e-3)
    dataset = open_dataset(given.dataset)
    splits = [load_split(dataset, name, config.labels) for name in ("train", "val")]
    runs = [
        compare(splits[0], splits[1], config.model_copy(update={"seed": seed}), given.steps, given.before)
        for seed in range(given.seeds)
    ]
    print(f"{'choice':12} {'cosine by stage':30} {'size by stage':30} {'loss':>18} {'val loss':>18}")
    result = {}
    for choice in CHOICES:
        cosine, size = (np.mean([run[choice][key] for run in runs], axis=0) for key in ("cosine", "size"))
        loss, val = ([run[choice][key] for run in runs] for key in ("loss", "val_loss"))
        result[choice] = {"cosine": cosine.tolist(), "size": size.tolist(), "loss": loss, "val_loss": val}
        shown = [" ".join(f"{value:.3f}" for value in values) for values in (cosine, loss, val)]
        sizes = " ".join(f"{value:.0e}" for value in size)
        print(f"{choice:12} {shown[0]:30} {sizes:30} {shown[1]:>18} {shown[2]:>18}")
    settings = {"width": given.width, "steps": given.steps, "before": given.before, "frames": len(splits[0])}
    write_figures(given.out, settings | {"choices": result})


if __name__ == "__main__":
    main()
