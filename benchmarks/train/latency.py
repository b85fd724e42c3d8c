"""Where the time of an image of 256 x 256 pixels goes, and what the processor could reach at best.

The networks of benchmarks.train.infer in OpenVINO (int8, other parts in bfloat16 if the processor has it) on one
thread and on two. OpenVINO counts the time of every operation. Operations are grouped: convolutions, attention (all of
CBAM), other operations. The limit is the time that the network's multiply-adds would take at the rate of the fastest
single int8 convolution that this processor ran (3 x 3, 512 to 512 channels, 32 x 32 pixels); no structure of
convolutions with as many multiply-adds is faster. Writes runs/bench/latency.json and latency.png.
"""

import os
import statistics
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Annotated, Any

import matplotlib.pyplot as plt
import numpy as np
import torch
import typer

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_train.detect.deploy.engines import has_bf16, openvino_core
from perilune_train.detect.deploy.files import FlightDetector, write_onnx
from perilune_train.detect.deploy.int8 import quantise
from perilune_train.models.size import multiply_adds
from perilune_train.models.yolo import YOLOv3

SIZE_PX, WARM_UP = 256, 5
GROUPS = ("convolution", "attention", "other")
_ATTENTION = ("attention", "squeeze", "excite", "spatial")
_PROBE = (512, 32)
"""Channels and side of the fastest convolution."""


def group_of(name: str, kind: str) -> str:
    """Group of an operation, from its name in the graph and its kind in OpenVINO."""
    if any(part in name.lower() for part in _ATTENTION):
        return "attention"
    return "convolution" if kind == "Convolution" else "other"


def profile(path: Path, channels: int, threads: int, rounds: int, size_px: int = SIZE_PX) -> dict[str, Any]:
    """Median seconds of a call without counters, and seconds by group with them."""
    core = openvino_core()
    settings: dict[str, Any] = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_NUM_THREADS": str(threads)}
    settings["INFERENCE_PRECISION_HINT"] = "bf16" if has_bf16() else "f32"
    image = np.random.default_rng(1).standard_normal((1, channels, size_px, size_px), np.float32)
    seconds, groups, kinds = [], defaultdict(list), defaultdict(list)
    for counted in (False, True):
        model = core.read_model(str(path))
        model.reshape({0: list(image.shape)})
        request = core.compile_model(model, "CPU", {**settings, "PERF_COUNT": counted}).create_infer_request()
        for number in range(WARM_UP + rounds):
            request.infer({0: image})
            if number < WARM_UP:
                continue
            if not counted:
                seconds.append(request.latency / 1e3)
                continue
            own: dict[str, float] = defaultdict(float)
            by_kind: dict[str, float] = defaultdict(float)
            for node in request.get_profiling_info():
                own[group_of(node.node_name, node.node_type)] += node.real_time.total_seconds()
                by_kind[f"{node.node_type} {node.exec_type}"] += node.real_time.total_seconds()
            for group in GROUPS:
                groups[group].append(own[group])
            for kind, value in by_kind.items():
                kinds[kind].append(value)
    largest = sorted(kinds, key=lambda kind: -statistics.median(kinds[kind]))[:8]
    return {
        "median_s": statistics.median(seconds),
        **{f"{group}_s": statistics.median(groups[group]) for group in GROUPS},
        "largest_s": {kind: statistics.median(kinds[kind]) for kind in largest},
    }


def peak_rate(folder: Path, threads: int, rounds: int) -> float:
    """Multiply-adds per second of a large int8 convolution."""
    channels, side = _PROBE
    layers = [torch.nn.Conv2d(channels, channels, 3, padding=1) for _ in range(4)]
    network = torch.nn.Sequential(*layers).eval()
    plain, small = folder / "probe.onnx", folder / "probe-int8.onnx"
    example = torch.zeros(1, channels, side, side)
    torch.onnx.export(network, (example,), str(plain), input_names=["images"], dynamo=False)
    quantise(plain, small, np.random.default_rng(0).standard_normal((2, channels, side, side), np.float32))
    found = profile(small, channels, threads, rounds, side)
    return len(layers) * channels**2 * 9 * side**2 / found["convolution_s"]


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Stacked bars of the groups, one for each network, with its limit as a line."""
    figure, axes = plt.subplots(figsize=(8, 0.5 * len(rows) + 1.2), layout="constrained")
    names = [f"{r['width']:g} {r['attention']} {' '.join(map(str, r['strides']))}, {r['threads']} thr." for r in rows]
    left = np.zeros(len(rows))
    for group in GROUPS:
        values = np.array([1e3 * row[f"{group}_s"] for row in rows])
        axes.barh(names, values, left=left, label=group)
        left += values
    axes.plot([1e3 * row["limit_s"] for row in rows], names, "k|", markersize=14, label="limit")
    axes.set_xlabel("milliseconds for an image of 256 x 256 pixels")
    axes.invert_yaxis()
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main(
    width: Annotated[list[float] | None, typer.Option(help="Only these widths; repeatable.")] = None,
    rounds: Annotated[int, typer.Option(help="Calls of each network.", min=3)] = 30,
    out: Path = Path("runs/bench"),
) -> None:
    """Profile all networks on one thread and on two."""
    cores = sorted(os.sched_getaffinity(0))[:2]
    os.sched_setaffinity(0, set(cores))
    rows, peaks = [], {}
    with tempfile.TemporaryDirectory() as folder:
        for threads in (1, 2):
            peaks[threads] = peak_rate(Path(folder), threads, rounds)
        for factor in width or (1.0, 0.5):
            for attention in ("none", "cbam_identity"):
                for strides in ((8, 16, 32), (4, 8, 16)):
                    torch.manual_seed(0)
                    network = YOLOv3(torch.full((3, 3, 2), 12.0), 1, factor, attention, strides).eval()
                    plain, small = Path(folder) / "network.onnx", Path(folder) / "network-int8.onnx"
                    write_onnx(FlightDetector(network, SIZE_PX), plain, {}, 1, SIZE_PX)
                    frames = np.random.default_rng(0).standard_normal((2, 1, SIZE_PX, SIZE_PX), np.float32)
                    quantise(plain, small, frames)
                    sums = multiply_adds(network, (1, 1, SIZE_PX, SIZE_PX))
                    for threads, peak in peaks.items():
                        row = {"width": factor, "attention": attention, "strides": strides, "threads": threads}
                        found = profile(small, 1, threads, rounds)
                        rows.append({**row, "multiply_adds": sums, "limit_s": sums / peak, **found})
                        print(
                            row,
                            {
                                key: round(1e3 * v, 1)
                                for key, v in rows[-1].items()
                                if key.endswith("_s") and isinstance(v, float)
                            },
                        )
    draw(rows, out / "latency.png")
    write_figures(out / "latency.json", {"peak_multiply_adds_per_s": peaks, "networks": rows})


if __name__ == "__main__":
    run_command_line(one_command(main))
