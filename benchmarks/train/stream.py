"""`navigate.stream` against the frames of a dataset at equal processor time. Writes runs/bench/stream.json.

Renders a small dataset of 64 px with the engine `heightfield`: three training scenes, four of validation. For each seed
and each share of rendered sequences (0: the dataset alone) one process trains a small `warp`. All train at the same
time, each with one thread and, with a share, with its own server of one thread. One epoch measures the processor time
of an epoch, with the server's; the number of epochs follows from `--cpu-s`. Start-up, this first epoch and the last
evaluation are not counted. The error is that of the best epoch and of the last, over all validation descents.
"""

import argparse
import json
import multiprocessing
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from benchmarks.figures import write_figures
from perilune_shared.config.yaml_text import to_yaml_text
from perilune_shared.dataset.manifest import open_dataset
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.data.stream import Stream
from perilune_train.motion.data.trajectories import load_trajectories
from perilune_train.motion.metrics.errors import motion_errors, summary
from perilune_train.motion.network import load_navigator, predict
from perilune_train.motion.train.task import NavigationTask
from perilune_train.training.fit import Hardware, Schedule, Wording, fit
from perilune_train.training.runs import RunFolder

DATASET = {
    "name": "stream-trial",
    "seed": 7,
    "camera": {"width_px": 64, "height_px": 64},
    "render": {"samples": 2, "engine": "heightfield", "threads": 1},
    "nav": {
        "n_scenes": 8,
        "trajectories_per_scene": 3,
        "n_frames": 40,
        "split_by": "scene",
        "val_share": 0.5,
        "test_share": 0.125,
    },
}
NETWORK = {
    "size_px": 64,
    "width": 0.125,
    "hidden": 64,
    "sequence_pairs": 8,
    "batch_sequences": 4,
    "coarse_epochs": 0,
    "learning_rate": 0.002,
    "jitter": 0.3,
}
SCENES = 5000
"""Number of scenes that a training may use."""
PROGRAM = Path(sys.executable).parent / "perilune-render"
"""The command line of the renderer, in the environment of this process."""


@contextmanager
def server(scene: Path, share: float, kind: str = "nav") -> Iterator[tuple[str, int | None]]:
    """A server in another process: its address and its process id; none is started for a share of 0."""
    if share == 0:
        yield "", None
        return
    options = ["--preset", "small", "--kind", kind, "--port", "0", "--native-port", "0", "--scenes", str(SCENES + 1)]
    command = [str(PROGRAM), "serve", "--scene", str(scene), *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            address = next(found[1] for line in process.stderr if (found := re.search(r"client at (tcp://\S+)", line)))
            yield address, process.pid
        finally:
            process.kill()


def processor_s(pid: int | None) -> float:
    """Processor time of this process and of another one so far, seconds."""
    other = 0.0
    if pid is not None:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        other = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return time.process_time() + other


def settings(seed: int, share: float, epochs: int, address: str) -> NavigateConfig:
    """The settings of one training."""
    network = NETWORK | {"fine_epochs": epochs}
    stream = {"address": address, "n_scenes": SCENES, "share": share, "seed": seed, "timeout_s": 600.0}
    return NavigateConfig.model_validate(
        {
            "seed": seed,
            "fusion": "warp",
            "device": "cpu",
            "precision": "float32",
            "warp": network,
            "stack": network,
            "stream": stream if share else None,
        }
    )


def trained(folder: Path, config: NavigateConfig, dataset: Path, pid: int | None) -> tuple[dict[str, float], RunFolder]:
    """Train; returns processor and wall-clock seconds, and the run."""
    opened, run = open_dataset(dataset), RunFolder(folder)
    stream = Stream(config.stream, opened) if config.stream else None
    torch.manual_seed(config.seed)
    task = NavigationTask(config, "warp", load_trajectories(opened), stream=stream)
    cpu, wall = processor_s(pid), time.monotonic()
    schedule = Schedule(config.warp.fine_epochs, "val/position_rmse_vector_m", "min")
    fit(run, task, schedule, Hardware("cpu", precision="float32"), Wording(folder.name))
    spent = {"processor_s": processor_s(pid) - cpu, "wall_s": time.monotonic() - wall}
    task.close()
    torch.save(task.network.state_dict(), folder / "last.pt")
    return spent, run


def one(out: Path, dataset: Path, scene: Path, share: float, seed: int, cpu_s: float) -> None:
    """One training and its evaluation, written to a file."""
    torch.set_num_threads(1)
    name = f"share-{share:g}-seed-{seed}"
    with server(scene, share) as (address, pid):
        spent, _ = trained(out / f"{name}-calibration", settings(seed, share, 1, address), dataset, pid)
        epochs = max(1, round(cpu_s / spent["processor_s"]))
        spent, run = trained(out / name, settings(seed, share, epochs, address), dataset, pid)
    validation = [one for one in load_trajectories(open_dataset(dataset)) if one.split == "val"]
    network, architecture = load_navigator(run.best, "warp")
    figures: dict[str, object] = {"share": share, "seed": seed, "epochs": epochs, **spent}
    for weights in ("best", "last"):
        if weights == "last":
            network.load_state_dict(torch.load(out / name / "last.pt", weights_only=True))
        found = summary(motion_errors(validation, [predict(network, architecture, each) for each in validation]))
        figures |= {f"{weights}/{key}": found[key] for key in ("position_rmse_vector_m", "orientation_rmse_angle_deg")}
    (out / f"{name}.json").write_text(json.dumps(figures))


def main() -> None:
    """Render, train all at the same time, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/bench/stream"))
    parser.add_argument("--shares", default="0,0.5,1")
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--cpu-s", type=float, default=300.0, help="processor time of each training, seconds")
    arguments = parser.parse_args()
    out, scene = arguments.out, arguments.out / "scene.yaml"
    dataset = out / "data" / "nav"
    out.mkdir(parents=True, exist_ok=True)
    scene.write_text(to_yaml_text({"dataset": DATASET}))
    if not (dataset / "dataset.json").is_file():
        rendering = ["--preset", "small", "--config", str(scene), "--kind", "nav", "--workers", "1"]
        subprocess.run([str(PROGRAM), "dataset", *rendering, "--out", str(out / "data")], check=True)
    cases = [(float(share), int(seed)) for seed in arguments.seeds.split(",") for share in arguments.shares.split(",")]
    began = os.getloadavg()[0]
    forked = multiprocessing.get_context("fork")  # imports take longer than a short training
    started = [forked.Process(target=one, args=(out, dataset, scene, *case, arguments.cpu_s)) for case in cases]
    for process in started:
        process.start()
    for process in started:
        process.join()
    if any(process.exitcode for process in started):
        raise SystemExit("a training failed")
    rows = [json.loads((out / f"share-{share:g}-seed-{seed}.json").read_text()) for share, seed in cases]
    load = {"load_before": began, "load_at_the_end": os.getloadavg()[0]}
    write_figures(Path("runs/bench/stream.json"), {"trainings": rows, **load})


if __name__ == "__main__":
    main()
