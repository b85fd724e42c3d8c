"""Training speed of the detector, compared with the same training fed from memory and a bare hand-written loop.

The three alternate in one process, since a machine's speed changes. Each turn trains the preset's network from the
same weights on the same batches; the first steps of a turn are not counted. Writes runs/bench/train.json.

- ours: `fit` as `detect train` calls it: frames augmented on the fly, moving average, clipping, schedule,
  TensorBoard, progress bar, checkpoints.
- memory: the same, with the batches prepared beforehand.
- bare: a loop of forward, loss, backward and AdamW's step (fused) in the same precision and memory layout, batches
  prepared beforehand; no schedule, no clipping, no moving average, no logging, no checkpoint.

On a GPU the network has the paper's full width by default, workers prepare the frames, and `gpu_waits` is the fraction
of the time of `ours` in which the GPU has finished a step and has not started the next one: it waits for the batch, or
copies it.
"""

import copy
import itertools
import statistics
import tempfile
import time
from pathlib import Path
from typing import Annotated

import torch
import typer
from lightning.pytorch.callbacks import Callback
from torch.utils.data import DataLoader

from benchmarks.figures import write_figures
from perilune_shared.config.resolve import resolve
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.threads import usable_cores
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.batches import network_input, training_loader
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.train.detect_run import build_network
from perilune_train.detect.train.loss import detection_loss
from perilune_train.detect.train.task import DetectTask
from perilune_train.models.yolo import YOLOv3
from perilune_train.training import runs
from perilune_train.training.fit import Hardware, Schedule, Wording, fit

_WARM_UP_STEPS = 3
_WORKERS = 8


class Clock(Callback):
    """Measures the time of the counted steps in seconds, and on a GPU how long it waits between them."""

    def __init__(self, gpu: bool):
        self.gpu = gpu
        self.events: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        if self.gpu:
            self.events.append((torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)))
            self.events[-1][0].record()

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        if self.gpu:
            self.events[-1][1].record()
        if batch_idx == _WARM_UP_STEPS - 1:
            self.start = self.now()
        if trainer.is_last_batch:
            self.seconds = self.now() - self.start

    def now(self) -> float:
        """Time in seconds after all steps so far."""
        if self.gpu:
            torch.cuda.synchronize()
        return time.perf_counter()

    def waits(self) -> float | None:
        """Fraction of the counted time in which the GPU waits between two steps; None without a GPU."""
        if not self.gpu:
            return None
        counted = self.events[_WARM_UP_STEPS:]
        gaps_ms = [end.elapsed_time(start) for (_, end), (start, _) in itertools.pairwise(counted)]
        return sum(gaps_ms) / counted[0][0].elapsed_time(counted[-1][1])


class Timed(DetectTask):
    """The detector's training, optionally with batches from memory."""

    batches: list | None = None

    def configure_callbacks(self) -> list[Callback]:
        self.clock = Clock(runs.choose_device(self.config.device) == "cuda")
        return [self.clock]

    def train_dataloader(self):
        if self.batches is None:
            return super().train_dataloader()
        # A DataLoader returns the batches unchanged. Lightning would treat a plain list as several loaders.
        return DataLoader(self.batches, batch_size=None, collate_fn=lambda batch: batch)  # type: ignore[arg-type]


def clock_of_fit(
    network: YOLOv3, config: DetectConfig, train: DetectSplit, val: DetectSplit, batches: list | None
) -> Clock:
    """The clock of an epoch of `fit`."""
    task = Timed(copy.deepcopy(network), config, train, val, 0)
    task.batches = batches
    with tempfile.TemporaryDirectory() as folder:
        run = runs.RunFolder(Path(folder))
        hardware = Hardware(precision=config.precision)
        fit(run, task, Schedule(1, "val/ap50_paper", "max"), hardware, Wording("train"))
    return task.clock


def seconds_of_bare_loop(network: YOLOv3, config: DetectConfig, batches: list, device: str, bf16: bool) -> float:
    """Time in seconds of the counted steps of the bare loop."""
    network = copy.deepcopy(network).to(device, memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(network.parameters(), config.learning_rate, fused=True)
    start = 0.0
    for step, (images, targets) in enumerate(batches):
        if step == _WARM_UP_STEPS:
            if device == "cuda":
                torch.cuda.synchronize()
            start = time.perf_counter()
        moved = network_input(images.to(device, non_blocking=True), config.in_channels)
        found = [part.to(torch.device(device)) for part in targets]
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            box, confidence = detection_loss(network(moved), found, network.anchors, network.strides, config.loss)
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
    steps: Annotated[int | None, typer.Option(help="Steps of a turn. [default: 40; 200 on a GPU]")] = None,
    turns: int = 5,
    width: Annotated[float | None, typer.Option(help="Width. [default: the preset's; 1 on a GPU]")] = None,
    out: Path = Path("runs/bench"),
) -> None:
    """Run the benchmark."""
    config = resolve(DetectConfig, "detect", "perilune_train", preset, None, ())
    device = runs.choose_device(config.device)
    bf16 = runs.choose_bf16(config.precision, device)
    gpu = device == "cuda"
    changes = {"width": width or (1.0 if gpu else config.width), "workers": config.workers}
    if gpu and not config.workers:
        changes["workers"] = min(_WORKERS, max(1, usable_cores() - 1))
    config = config.model_copy(update=changes)
    whole = load_split(open_dataset(dataset), "val", config.labels)
    steps = min(steps or (200 if gpu else 40), len(whole) // config.batch_size)
    train, val = whole.first(steps * config.batch_size), whole.first(config.batch_size)
    network = build_network(config, train.label_sizes_px, dataset)
    batches = list(training_loader(train, config, network.anchors))
    seconds: dict[str, list[float]] = {"ours": [], "memory": [], "bare": []}
    waits = []
    for _ in range(turns):
        clock = clock_of_fit(network, config, train, val, None)
        seconds["ours"].append(clock.seconds)
        waits.append(clock.waits())
        seconds["memory"].append(clock_of_fit(network, config, train, val, batches).seconds)
        seconds["bare"].append(seconds_of_bare_loop(network, config, batches, device, bf16))
    # Ratios of neighbouring turns, since the machine's speed changes over time.
    ratios = {
        name: [other / own for own, other in zip(seconds["ours"], seconds[name], strict=True)]
        for name in ("memory", "bare")
    }
    counted = (steps - _WARM_UP_STEPS) * config.batch_size
    result = {
        "images_per_s": counted / statistics.median(seconds["ours"]),
        "bare_images_per_s": counted / statistics.median(seconds["bare"]),
        "ratio_to_memory": statistics.median(ratios["memory"]),
        "ratio_to_bare": statistics.median(ratios["bare"]),
        "gpu_waits": statistics.median(value for value in waits if value is not None) if gpu else None,
        "seconds": seconds,
        "preset": preset,
        "width": config.width,
        "workers": config.workers,
        "steps": steps - _WARM_UP_STEPS,
        "batch_size": config.batch_size,
        "threads": torch.get_num_threads(),
        "device": device,
        "bf16": bf16,
    }
    write_figures(out / "train.json", result)


if __name__ == "__main__":
    run_command_line(one_command(main))
