"""`detect.fresh` against stored frames at equal processor time, rendering included. Writes runs/bench/fresh.json.

Renders a small dataset of 96 px with the engine `heightfield`: three training scenes, four of validation. For each
seed, one process trains a small detector in each of these ways:

- stored: on the frames of the dataset alone.
- larger: on the frames of a second dataset with eight training scenes. Its rendering is counted.
- share-S: a share S of the frames is rendered during training, by a server of its own. The server is counted.

All train at the same time, each with one thread. The second of two epochs measures the processor time of an epoch; the
number of epochs follows from `--cpu-s`, so that each training has a whole cosine of the learning rate. Start-up and
these two epochs are not counted, nor is the rendering of the small dataset, whose validation frames and poses all ways
need. The figure is the AP of the moving average of the weights after the last epoch, over all validation frames.
"""

import argparse
import json
import multiprocessing
import os
import resource
import subprocess
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import torch

from benchmarks.figures import write_figures
from benchmarks.train.stream import PROGRAM, SCENES, processor_s, server
from perilune_shared.config.resolve import resolve
from perilune_shared.config.yaml_text import to_yaml_text
from perilune_shared.dataset.manifest import open_dataset
from perilune_train.detect.config import DetectConfig, FreshConfig
from perilune_train.detect.data.fresh import FreshFrames, FreshServer
from perilune_train.detect.data.split import load_split
from perilune_train.detect.train.detect_run import build_network
from perilune_train.detect.train.task import DetectTask
from perilune_train.training.fit import Hardware, Schedule, Wording, fit
from perilune_train.training.runs import RunFolder

SMALL: dict[str, Any] = {
    "name": "fresh-trial",
    "seed": 7,
    "camera": {"width_px": 96, "height_px": 96},
    "render": {"samples": 2, "engine": "heightfield", "threads": 1, "cache_gib": 0.0},
    "detect": {
        "n_scenes": 8,
        "trajectories_per_scene": 1,
        "n_frames": 32,
        "split_by": "scene",
        "val_share": 0.5,
        "test_share": 0.125,
    },
}
LARGER = SMALL | {
    "name": "fresh-trial-larger",
    "detect": {**SMALL["detect"], "n_scenes": 10, "val_share": 0.1, "test_share": 0.1},
}
NETWORK = (
    "detect.width=0.125",
    "detect.in_channels=1",
    "detect.attention=none",
    "detect.ellipses=false",
    "detect.strides=[4, 8, 16]",
    "detect.batch_size=8",
    "detect.learning_rate=0.002",
    "detect.warmup_steps=50",
    "detect.precision=float32",
    "detect.device=cpu",
)
_CALIBRATION_EPOCHS = 2
_KEPT = ("val/ap50_paper", "val/f1", "val/recall")


class Timed(DetectTask):
    """Training that notes the processor time after every step."""

    pid: int | None = None
    """Process id of the server; None without a server."""

    def on_train_batch_end(self, *_: Any) -> None:
        """Note the processor time so far, seconds."""
        self.noted = [*getattr(self, "noted", []), processor_s(self.pid)]


def settings(seed: int, share: float, epochs: int, address: str) -> DetectConfig:
    """The settings of one training, with one validation at its end."""
    own = (*NETWORK, f"detect.seed={seed}", f"detect.epochs={epochs}", f"detect.validate_every={epochs}")
    config = resolve(DetectConfig, "detect", "perilune_train", "small", None, own)
    if share == 0:
        return config
    fresh = FreshConfig(address=address, n_scenes=SCENES, share=share, seed=seed, timeout_s=600.0)
    return config.model_copy(update={"fresh": fresh})


def trained(
    folder: Path, config: DetectConfig, train: Path, val: Path, pid: int | None
) -> tuple[dict[str, Any], Timed]:
    """Train on the training split of one dataset and validate on another; returns figures and the task."""
    opened = open_dataset(train)
    split = load_split(opened, "train", config.labels, config.augment.scale)
    validation = load_split(open_dataset(val), "val", config.labels)
    used = split if config.fresh is None else FreshFrames(split, config, opened, FreshServer(config.fresh, opened))
    task = Timed(build_network(config, split.label_sizes_px, train), config, used, validation, 0)
    task.pid = pid
    schedule = Schedule(config.epochs, "val/ap50_paper", "max", validate_every=config.validate_every)
    cpu, wall = processor_s(pid), time.monotonic()
    with closing(task):
        fit(RunFolder(folder), task, schedule, Hardware("cpu", precision="float32"), Wording(folder.name))
    figures = {"processor_s": processor_s(pid) - cpu, "wall_s": time.monotonic() - wall, "frames": task.images_seen}
    if isinstance(used, FreshFrames):
        figures["scenes"] = len(used.server.uses)
    return figures | {name: float(task.trainer.callback_metrics[name]) for name in _KEPT}, task


def one(out: Path, way: str, seed: int, cpu_s: float, rendering_s: float) -> None:
    """One training, written to a file."""
    torch.set_num_threads(1)
    share = float(way.removeprefix("share-")) if way.startswith("share-") else 0.0
    val = out / "small" / "detect"
    train = out / "larger" / "detect" if way == "larger" else val
    before_s = rendering_s if way == "larger" else 0.0
    name = f"{way}-seed-{seed}"
    with server(out / "small.yaml", share, "detect") as (address, pid):
        _, task = trained(
            out / f"{name}-calibration", settings(seed, share, _CALIBRATION_EPOCHS, address), train, val, pid
        )
        steps = len(task.noted) // _CALIBRATION_EPOCHS
        epoch_s = (task.noted[-1] - task.noted[steps - 1]) / (_CALIBRATION_EPOCHS - 1)
        epochs = max(1, round((cpu_s - before_s) / epoch_s))
        figures, _ = trained(out / name, settings(seed, share, epochs, address), train, val, pid)
    row = {"way": way, "seed": seed, "epochs": epochs, "rendered_before_s": before_s, **figures}
    (out / f"{name}.json").write_text(json.dumps(row))


def rendered(out: Path, name: str, dataset: dict[str, Any]) -> float:
    """Render a dataset unless it exists; returns the processor time of its rendering, seconds."""
    configuration, noted = out / f"{name}.yaml", out / f"{name}.json"
    configuration.write_text(to_yaml_text({"dataset": dataset}))
    if not noted.is_file():
        options = ["--preset", "small", "--config", str(configuration), "--kind", "detect", "--workers", "1"]
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([str(PROGRAM), "dataset", *options, "--out", str(out / name)], check=True)
        now = resource.getrusage(resource.RUSAGE_CHILDREN)
        noted.write_text(json.dumps(now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime))
    return float(json.loads(noted.read_text()))


def main() -> None:
    """Render, train all at the same time, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/bench/fresh"))
    parser.add_argument("--ways", default="stored,larger,share-0.1,share-1")
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--cpu-s", type=float, default=60.0, help="processor time of each training, seconds")
    arguments = parser.parse_args()
    out = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    small_s, larger_s = rendered(out, "small", SMALL), rendered(out, "larger", LARGER)
    cases = [(way, int(seed)) for seed in arguments.seeds.split(",") for way in arguments.ways.split(",")]
    began = os.getloadavg()[0]
    forked = multiprocessing.get_context("fork")  # imports take longer than a short training
    started = [forked.Process(target=one, args=(out, *case, arguments.cpu_s, larger_s)) for case in cases]
    for process in started:
        process.start()
    for process in started:
        process.join()
    if any(process.exitcode for process in started):
        raise SystemExit("a training failed")
    rows = [json.loads((out / f"{way}-seed-{seed}.json").read_text()) for way, seed in cases]
    load = {"load_before": began, "load_at_the_end": os.getloadavg()[0]}
    rendering = {"rendering_small_s": small_s, "rendering_larger_s": larger_s}
    write_figures(Path("runs/bench/fresh.json"), {"trainings": rows, **rendering, **load})


if __name__ == "__main__":
    main()
