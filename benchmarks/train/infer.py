"""Inference time per image of 256 x 256 pixels for every engine, on two cores.

Two cores represent a flight computer. Measures networks of full and half width, without and with attention, with both
sets of strides, with random weights (which do not affect the speed), or the network of a run. Every engine is warmed
up, then all are called in turn, so that other load on the machine affects all equally. Writes
runs/bench/infer.json.
"""

import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.console.terminal import progress_bar
from perilune_train.detect.deploy.engines import Engine, has_bf16, onnxruntime_engine, openvino_engine, torch_engine
from perilune_train.detect.deploy.export import load_trained
from perilune_train.detect.deploy.files import FlightDetector, write_onnx
from perilune_train.detect.deploy.int8 import interleaved, quantise
from perilune_train.models.size import multiply_adds
from perilune_train.models.yolo import YOLOv3

CORES, SIZE_PX, WARM_UP = 2, 256, 5
GOALS_S = {1.0: 0.030, 0.5: 0.010}
"""Goal for the best engine in seconds, by width."""


class Eager(torch.nn.Module):
    """The network as trained, called as in the trainer."""

    def __init__(self, network: YOLOv3):
        super().__init__()
        self.network = network

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.network.detect(images)


def _n_channels(network: YOLOv3) -> int:
    first = network.backbone.stem[0]
    assert isinstance(first, torch.nn.Conv2d)
    return first.in_channels


def engines(network: YOLOv3, folder: Path) -> dict[str, Engine]:
    """All engines for one network; writes their files into `folder`."""
    channels = _n_channels(network)
    flight = FlightDetector(network, SIZE_PX)
    plain, small = folder / "network.onnx", folder / "network-int8.onnx"
    write_onnx(flight, plain, {}, channels, SIZE_PX)
    quantise(plain, small, np.random.default_rng(0).standard_normal((2, channels, SIZE_PX, SIZE_PX), np.float32))
    traced = torch.jit.optimize_for_inference(torch.jit.trace(flight, torch.zeros(1, channels, SIZE_PX, SIZE_PX)))
    made = {
        "torch f32": torch_engine(Eager(network)),
        "torch folded f32": torch_engine(flight),
        "torch jit f32": torch_engine(traced),
        "onnxruntime f32": onnxruntime_engine(plain, CORES),
        "onnxruntime int8": onnxruntime_engine(small, CORES),
        **openvino_engines(plain, small, CORES),
    }
    if has_bf16():
        made["torch bf16"] = torch_engine(Eager(network), "bf16")
        made["torch folded bf16"] = torch_engine(flight, "bf16")
    return made


def openvino_engines(plain: Path, small: Path, threads: int) -> dict[str, Engine]:
    """OpenVINO's engines for the floating-point file and the int8 file."""
    made = {}
    for precision in ("f32", "bf16") if has_bf16() else ("f32",):
        made[f"openvino {precision}"] = openvino_engine(plain, precision, threads, 1)
        made[f"openvino int8 {precision}"] = openvino_engine(small, precision, threads, 1)
    return made


def cpu_seconds(engine: Engine, image: np.ndarray, rounds: int) -> float:
    """Median processor time of a call on one thread; hardly affected by other programs."""
    seconds = []
    for _ in range(WARM_UP + rounds):
        start = time.process_time()
        engine(image)
        seconds.append(time.process_time() - start)
    return statistics.median(seconds[WARM_UP:])


def measure(network: YOLOv3, rounds: int) -> dict:
    """Minimum and median time of every engine, processor time on one thread, and the best engines."""
    channels = _n_channels(network)
    image = np.random.default_rng(1).standard_normal((1, channels, SIZE_PX, SIZE_PX), np.float32)
    with tempfile.TemporaryDirectory() as folder:
        seconds = interleaved(engines(network, Path(folder)), image, rounds, WARM_UP)
        single = openvino_engines(Path(folder) / "network.onnx", Path(folder) / "network-int8.onnx", 1)
        one_thread = {name: cpu_seconds(engine, image, rounds) for name, engine in single.items()}
    table = {name: {"median_s": statistics.median(part), "least_s": min(part)} for name, part in seconds.items()}
    best = min(table, key=lambda name: table[name]["median_s"])
    exact = min((name for name in table if "int8" not in name), key=lambda name: table[name]["median_s"])
    return {
        "multiply_adds": multiply_adds(network, image.shape),
        "engines": table,
        "one_thread_cpu_s": one_thread,
        "best": best,
        "best_s": table[best]["median_s"],
        "best_without_int8": exact,
        "best_without_int8_s": table[exact]["median_s"],
    }


def main(
    run: Annotated[Path | None, typer.Option(help="A finished detect run, instead of the random networks.")] = None,
    width: Annotated[list[float] | None, typer.Option(help="Only these widths; repeatable.")] = None,
    rounds: Annotated[int, typer.Option(help="Calls of each engine.", min=3)] = 40,
    out: Path = Path("runs/bench"),
) -> None:
    """Measure all networks, or that of a run."""
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:CORES]))
    torch.set_num_threads(CORES)
    networks: list[tuple[float, str, tuple[int, ...], YOLOv3 | None]] = []
    if run is not None:
        trained = load_trained(run)
        networks.append((trained.config.width, trained.config.attention, trained.config.strides, trained.network))
    else:
        for factor in width or (1.0, 0.5):
            for attention in ("none", "cbam_identity"):
                networks += [(factor, attention, strides, None) for strides in ((8, 16, 32), (4, 8, 16))]
    rows = []
    with progress_bar() as bar:
        task = bar.add_task("networks", total=len(networks), unit="networks", note="")
        for factor, attention, strides, network in networks:
            torch.manual_seed(0)
            made = network or YOLOv3(torch.full((3, 3, 2), 12.0), 1, factor, attention, strides).eval()  # type: ignore[arg-type]
            row = {"width": factor, "attention": attention, "strides": list(strides), **measure(made, rounds)}
            goal = GOALS_S.get(factor)
            rows.append({**row, "goal_s": goal, "reached": None if goal is None else row["best_s"] <= goal})
            bar.advance(task)
    slowest = {
        f"width_{row['width']:g}_s": max(r["best_s"] for r in rows if r["width"] == row["width"]) for row in rows
    }
    figures = {"cores": CORES, "size_px": SIZE_PX, "rounds": rounds, "slowest": slowest, "networks": rows}
    path = out / ("infer.json" if run is None else f"infer-{run.name}.json")
    write_figures(path, figures)
    print_table(rows)


def print_table(rows: list[dict]) -> None:
    """Median (minimum) in milliseconds, as a Markdown table."""
    heads = [f"{row['width']:g} {row['attention']} {' '.join(map(str, row['strides']))}" for row in rows]
    print("| Engine, ms | " + " | ".join(heads) + " |\n|---|" + "---|" * len(rows))
    for name in rows[0]["engines"]:
        cells = [row["engines"][name] for row in rows]
        print(
            f"| {name} | " + " | ".join(f"{1e3 * c['median_s']:.1f} ({1e3 * c['least_s']:.1f})" for c in cells) + " |"
        )
    for name in rows[0]["one_thread_cpu_s"]:
        cells = [f"{1e3 * row['one_thread_cpu_s'][name]:.1f}" for row in rows]
        print(f"| {name}, processor time on one thread | " + " | ".join(cells) + " |")
    for head, row in zip(heads, rows, strict=True):
        if row["goal_s"] is not None:
            words = "reached" if row["reached"] else "missed"
            print(f"{head}: {row['best']} {1e3 * row['best_s']:.1f} ms, goal {1e3 * row['goal_s']:.0f} ms {words}")


if __name__ == "__main__":
    run_command_line(one_command(main))
