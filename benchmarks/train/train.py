"""Training speed of the detector, compared with the same training fed from memory and a bare hand-written loop.

The three alternate in one process, since a machine's speed changes. Each turn trains the preset's network from the
same weights on the same batches; the first steps of a turn are not counted. Writes runs/bench/train.json.

- ours: `fit` as `detect train` calls it: frames augmented on the fly, moving average, clipping, schedule,
  TensorBoard, progress bar, checkpoints.
- memory: the same, with the batches prepared beforehand.
- bare: a loop of forward, loss, backward and AdamW's step (fused) in the same precision and memory layout, batches
  prepared beforehand; no schedule, no clipping, no moving average, no logging, no checkpoint.
"""

import copy
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import typer
from lightning.pytorch.callbacks import Callback
from torch.utils.data import DataLoader

from benchmarks.figures import write_figures
from perilune_shared.config import resolve
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import run_command_line
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.batches import TrainingFrames, loader
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.train.loss import detection_loss
from perilune_train.detect.train.network import build_network, label_sizes
from perilune_train.detect.train.task import DetectTask
from perilune_train.models.yolo import YOLOv3
from perilune_train.training import runs
from perilune_train.training.fit import fit

_WARM_UP_STEPS = 3


class Clock(Callback):
    """Measures the time of the counted steps in seconds."""

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        if batch_idx == _WARM_UP_STEPS - 1:
            self.start = time.perf_counter()
        self.seconds = time.perf_counter() - getattr(self, "start", 0.0)


class Timed(DetectTask):
    """The detector's training, optionally with batches from memory."""

    batches: list | None = None

    def configure_callbacks(self) -> list[Callback]:
        self.clock = Clock()
        return [self.clock]

    def train_dataloader(self):
        if self.batches is None:
            return super().train_dataloader()
        # A DataLoader returns the batches unchanged. Lightning would treat a plain list as several loaders.
        return DataLoader(self.batches, batch_size=None, collate_fn=lambda batch: batch)  # type: ignore[arg-type]


def first_frames(split: DetectSplit, count: int) -> DetectSplit:
    """The first `count` frames of a split."""
    frames = replace(split.frames, table=split.frames.table.iloc[:count], images=split.frames.images[:count])
    return replace(split, frames=frames, labels=split.labels[:count])


def seconds_of_fit(
    network: YOLOv3, config: DetectConfig, train: DetectSplit, val: DetectSplit, batches: list | None
) -> float:
    """Time in seconds of the counted steps of an epoch of `fit`."""
    task = Timed(copy.deepcopy(network), config, train, val, 0)
    task.batches = batches
    with tempfile.TemporaryDirectory() as folder:
        run = runs.RunFolder(Path(folder))
        fit(run, task, label="train", epochs=1, monitor="val/ap50_paper", mode="max", precision=config.precision)
    return task.clock.seconds


def seconds_of_bare_loop(network: YOLOv3, config: DetectConfig, batches: list, device: str, bf16: bool) -> float:
    """Time in seconds of the counted steps of the bare loop."""
    network = copy.deepcopy(network).to(device, memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(network.parameters(), config.learning_rate, fused=True)
    start = 0.0
    for step, (images, targets) in enumerate(batches):
        if step == _WARM_UP_STEPS:
            start = time.perf_counter()
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            outputs = network(images.to(device))
            box, confidence = detection_loss(
                outputs,
                targets.to(torch.device(device)),
                network.anchors,
                network.strides,
                config.anchor_ratio,
                config.loss,
            )
            loss = config.loss.lambda_iou * box + config.loss.lambda_obj * confidence
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def main(
    dataset: Annotated[Path, typer.Option(help="Folder of a detect dataset.")] = Path("data/small/detect"),
    preset: str = "small",
    steps: Annotated[int, typer.Option(help="Steps of a turn.")] = 40,
    turns: int = 5,
    out: Path = Path("runs/bench"),
) -> None:
    """Run the benchmark."""
    config = resolve(DetectConfig, "detect", "perilune_train", preset, None, ())
    device = runs.choose_device(config.device)
    bf16 = runs.choose_bf16(config.precision, device)
    whole = load_split(open_dataset(dataset), "val", config.labels)
    train, val = first_frames(whole, steps * config.batch_size), first_frames(whole, config.batch_size)
    steps = len(train) // config.batch_size
    train = first_frames(train, steps * config.batch_size)
    network = build_network(config, label_sizes(train), dataset)
    batches = list(loader(TrainingFrames(train, config.augment, config.seed, 0), config))
    seconds: dict[str, list[float]] = {"ours": [], "memory": [], "bare": []}
    for _ in range(turns):
        seconds["ours"].append(seconds_of_fit(network, config, train, val, None))
        seconds["memory"].append(seconds_of_fit(network, config, train, val, batches))
        seconds["bare"].append(seconds_of_bare_loop(network, config, batches, device, bf16))
    # Ratios of neighbouring turns, since the machine's speed changes over time.
    ratios = {
        name: [other / own for own, other in zip(seconds["ours"], seconds[name], strict=True)]
        for name in ("memory", "bare")
    }
    result = {
        "images_per_s": (steps - _WARM_UP_STEPS) * config.batch_size / statistics.median(seconds["ours"]),
        "ratio_to_memory": statistics.median(ratios["memory"]),
        "ratio_to_bare": statistics.median(ratios["bare"]),
        "seconds": seconds,
        "preset": preset,
        "steps": steps - _WARM_UP_STEPS,
        "batch_size": config.batch_size,
        "threads": torch.get_num_threads(),
        "device": device,
        "bf16": bf16,
    }
    write_figures(out / "train.json", result)


if __name__ == "__main__":
    run_command_line(lambda: typer.run(main))
