"""Training speed of the paper's detectors on a GPU: frames on the device, steps one operation at a time or captured.

Random frames and labels; the figures are images per second. Runs on a CPU too, where nothing is captured. Writes
runs/bench/captured.json.

    python -m benchmarks.train.captured --width 1 --frames 512 --steps 20
"""

import itertools
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch
import typer

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import run_command_line
from perilune_train.data.frames import FrameStore
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.data.resident import ResidentFrames
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.train.captured import CapturedStep
from perilune_train.detect.train.detect_run import build_network
from perilune_train.detect.train.task import DetectTask
from perilune_train.training.runs import choose_bf16, choose_device

_SIZE_PX, _LABELS = 256, 40
_PLAIN = {"flips_and_turns": False, "gain": 0.0, "gamma": 0.0, "blur_px": 0.0, "noise": 0.0}


def random_split(n_frames: int) -> DetectSplit:
    """Frames of noise with labels of 2 to 30 px radius at random places."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (n_frames, _SIZE_PX, _SIZE_PX), np.uint8)
    labels = []
    for _ in range(n_frames):
        centre, radius = rng.uniform(0, _SIZE_PX, (_LABELS, 2)), 2 * 15 ** rng.random(_LABELS)
        boxes = np.concatenate([centre - radius[:, None], centre + radius[:, None]], 1)
        ellipses = np.column_stack([centre, radius, radius, np.zeros(_LABELS)])
        all_of_them = np.ones(_LABELS, bool)
        labels.append(FrameLabels(boxes, radius, ellipses, all_of_them, all_of_them))
    sizes = np.concatenate([one.boxes[:, 2:] - one.boxes[:, :2] for one in labels])
    return DetectSplit(FrameStore(pd.DataFrame(), images), labels, (2.0, 50.0), sizes, n_frames)


def images_per_s(split: DetectSplit, config: DetectConfig, captured: bool, steps: int, fused: bool) -> dict[str, Any]:
    """Speed of training steps, and the largest memory."""
    device = torch.device(choose_device("auto"))
    network = build_network(config, split.label_sizes_px, "random labels")
    task = DetectTask(network, config, split, split, 0).to(device).train()
    optimizer = task.configure_optimizers()["optimizer"]
    task.optimizers = lambda use_pl_optimizer=True: optimizer
    task.resident = ResidentFrames.of(split, config, task.network.anchors, device)
    if fused:
        for gate in task.network.backbone.attentions.values():
            gate.compile()
    step = CapturedStep(task.whole_step, config.batch_size, device) if captured else task.whole_step
    order = torch.arange(len(split), device=device)

    def run(count: int) -> float:
        started = time.perf_counter()
        for k in range(count):
            first = k * config.batch_size % (len(split) - config.batch_size + 1)
            with torch.autocast(device.type, torch.bfloat16, choose_bf16("auto", device.type)):
                losses = step(order[first : first + config.batch_size])
        if device.type == "cuda":
            torch.cuda.synchronize()
        assert all(torch.isfinite(loss) for loss in losses)
        return time.perf_counter() - started

    warm_s = run(5)
    seconds = run(steps)
    memory_gb = torch.cuda.max_memory_allocated() / 1e9 if device.type == "cuda" else 0.0
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    return {
        "images_per_s": round(steps * config.batch_size / seconds, 1),
        "first_steps_s": round(warm_s, 1),
        "memory_gb": round(memory_gb, 2),
    }


def main(
    width: Annotated[float, typer.Option(help="Width of the network.")] = 1.0,
    frames: Annotated[int, typer.Option(help="Number of frames.")] = 512,
    steps: Annotated[int, typer.Option(help="Steps that are timed.")] = 20,
    batch: Annotated[list[int] | None, typer.Option(help="Batch sizes. Repeatable.")] = None,
    attention: Annotated[list[str] | None, typer.Option(help="Forms of attention. Repeatable.")] = None,
    fused: Annotated[bool, typer.Option(help="Also compile the attention modules.")] = False,
    out: Annotated[Path, typer.Option(help="JSON file with the figures.")] = Path("runs/bench/captured.json"),
) -> None:
    """Time training steps of both detectors."""
    split, figures = random_split(frames), {}
    torch.use_deterministic_algorithms(True, warn_only=True)
    setattr(torch.utils.deterministic, "fill_uninitialized_memory", False)  # noqa: B010
    ways = [
        ("one by one", False, False),
        ("captured", True, False),
        *([("captured, fused", True, True)] if fused else []),
    ]
    forms = attention or ["none", "cbam"]
    for form, size, (way, captured, compiled) in itertools.product(forms, batch or [32], ways):
        if compiled and (form == "none" or not fused):
            continue
        config = DetectConfig.model_validate(
            {"width": width, "attention": form, "batch_size": size, "assignment": "one", "augment": _PLAIN}
        )
        found = images_per_s(split, config, captured, steps, compiled)
        print(f"{form}, batch {size}, {way}: {found}", flush=True)
        figures[f"{form}, batch {size}, {way}"] = found
    write_figures(out, figures)


if __name__ == "__main__":
    app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
    app.command()(main)
    run_command_line(app)
