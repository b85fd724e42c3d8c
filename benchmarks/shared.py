"""Speed beside other work: training, detection, rendering with both engines, and the filter.

Each workload runs alone, beside one busy process, beside four niced ones (nice 10), and under a processor quota of
half a core. The figure is its speed relative to alone, divided by its fair share of the processor: the weights of its
threads or processes over those of all, on all cores. 1 is fair; fewer threads than cores can be above it.

For training and detection, `before` repeats the first three with OpenMP's default of spinning and a constant number
of threads. The quota needs root and a kernel with cgroups whose processor controller may be used; else it is left out.
Writes runs/bench/shared.json.

    python -m benchmarks.shared --seconds 15 --rounds 3 --workload training
"""

import contextlib
import itertools
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.errors import UserError
from perilune_shared.threads import cores_in_affinity

Step = Callable[[], object]
_WEIGHT, _NICED_WEIGHT = 1024, 110
"""Weights of the Linux scheduler for nice 0 and nice 10."""
_QUOTA_CORES, _PERIOD_US = 0.5, 100_000
_BEFORE = {"GOMP_SPINCOUNT": "300000", "OMP_NUM_THREADS": str(cores_in_affinity())}
"""The defaults of libgomp, and a number of threads that stays."""
_BUSY = "while True: pass"


def training() -> Step:
    """Steps of detector training: batches of four frames of 256 px, the network of `small`."""
    import torch

    from perilune_shared.config.resolve import resolve
    from perilune_train.detect.config import DetectConfig
    from perilune_train.models.yolo import YOLOv3
    from perilune_train.training.fair_threads import FairThreads
    from perilune_train.training.runs import choose_bf16

    config = resolve(DetectConfig, "detect", "perilune_train", "small")
    torch.manual_seed(0)
    network = YOLOv3(None, config.in_channels, config.width, config.attention, config.strides)
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(network.parameters(), 1e-4, fused=True)
    images = torch.randn(config.batch_size, config.in_channels, 256, 256).contiguous(memory_format=torch.channels_last)
    bf16, threads = choose_bf16(config.precision, "cpu"), FairThreads()

    def step() -> None:
        with threads:
            with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
                loss = sum(output.float().square().mean() for output in network(images))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

    return step


def detection() -> Step:
    """Batches of four frames of 256 px through the installed detector."""
    import numpy as np

    from perilune_train.detect.finished_run import config_of_run
    from perilune_train.detect.inference.detector import open_run
    from perilune_train.detect.inference.scales import detect_at_scales
    from perilune_train.shipped.models import shipped_run

    run = shipped_run("detect")
    detector = open_run(run, config_of_run(run, ()))
    frames = np.random.default_rng(0).integers(0, 255, (4, 256, 256), np.uint8)
    return lambda: detect_at_scales(detector, frames)


def _frames(engine: str) -> Step:
    """Frames of the first scene of `small` by one thread; each core has a process, as in `perilune-render dataset`."""
    from perilune_render.config.dataset import DatasetConfig
    from perilune_render.dataset.shots import planned_shot
    from perilune_render.engines.frame_source import FrameSource
    from perilune_render.engines.open_engine import open_engine
    from perilune_render.flight.plan import make_plan
    from perilune_render.labels.frame_labels import RimCircles
    from perilune_render.terrain.cache import cached_scene
    from perilune_shared.config.resolve import resolve

    settings = (f"dataset.render.engine={engine}", "dataset.render.threads=1")
    config = resolve(DatasetConfig, "dataset", "perilune_render", "small", None, settings)
    plan = make_plan(config, "detect")
    one = plan.scenes[0]
    scene = cached_scene(config, plan.view, one.seed)
    opened = contextlib.ExitStack().enter_context(open_engine(scene, config, plan.exr_camera, one.sun))
    source = FrameSource.of(opened, config, plan.exr_camera, RimCircles.of_scene(scene))
    trajectory = plan.of_scene(one.scene_id)[0]
    places = itertools.cycle(range(len(trajectory.splits)))

    def step() -> None:
        source.labels(source.take(planned_shot(trajectory, next(places))))

    return step


def rendering() -> Step:
    """Frames by Blender, with sensor and labels."""
    return _frames("cycles")


def heightfield() -> Step:
    """Frames by the engine `heightfield`, with sensor and labels."""
    return _frames("heightfield")


def filtering() -> Step:
    """A second of the filter's flight: 50 inertial measurements, 10 ranges, over a catalogue of 2000 craters."""
    import numpy as np

    from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera
    from perilune_shared.geometry.gravity import gravity_mps2
    from perilune_shared.geometry.inertial_grades import GRADES
    from perilune_train.landing.craters.catalogue import Catalogue
    from perilune_train.landing.filter.lander import Lander, Surroundings
    from perilune_train.landing.filter.propagate import Increments, InertialNoise, start_sigmas
    from perilune_train.landing.filter.state import State

    rng, grade = np.random.default_rng(0), GRADES["tactical"]
    places = np.column_stack([rng.uniform(-2000, 2000, (2000, 2)), np.zeros(2000)])
    catalogue = Catalogue(places, np.tile([0.0, 0.0, 1.0], (2000, 1)), rng.uniform(2, 50, 2000), 1.0, 0.03)
    around = Surroundings(Camera.from_field_of_view(256, 256, 45.0), ROTATION_CAMERA_FROM_BODY, catalogue, 2.0, 5.0)
    start = State.starting(np.array([0.0, 0, 1400]), np.zeros(3), np.eye(3), start_sigmas(20, 1, 0.3, grade), 5.0)
    lander = Lander(start, InertialNoise.of(grade), around)
    hover, ticks = -gravity_mps2(1400.0), itertools.count(1)

    def step() -> None:
        for _ in range(50):
            tick = next(ticks)
            lander.inertial(Increments.single(0.02 * tick, 0.02, np.zeros(3), np.asarray(hover)))
            if tick % 5 == 0:
                lander.range(float(lander.state.position_m[2]))

    return step


WORKLOADS = {work.__name__: work for work in (training, detection, rendering, heightfield, filtering)}
PROCESSES = {"rendering", "heightfield"}
"""Workloads with a process for each core; the others are one process, with a thread for each core, or one thread."""
SPINNING = ("training", "detection")


@dataclass(frozen=True, slots=True)
class Condition:
    """What else the machine does."""

    name: str
    n_busy: int = 0
    """Number of other busy processes."""
    nice: int = 0
    """Their niceness."""
    quota: bool = False
    """Whether the workload has half a core."""
    before: bool = False
    """Whether OpenMP spins by its defaults."""


ALONE = Condition("alone")
CONDITIONS = (
    ALONE,
    Condition("before, alone", before=True),
    Condition("beside one busy process", n_busy=1),
    Condition("before, beside one busy process", n_busy=1, before=True),
    Condition("beside four niced processes", n_busy=4, nice=10),
    Condition("before, beside four niced processes", n_busy=4, nice=10, before=True),
    Condition("half a core", quota=True),
)


def fair_share(workload: str, condition: Condition) -> float:
    """Fair share of the processor under a condition, relative to what the workload uses alone."""
    cores = cores_in_affinity()
    n_own = 1 if workload == "filtering" else cores
    if condition.quota:
        return min(_QUOTA_CORES / n_own, 1.0)
    weight = _WEIGHT if condition.nice == 0 else _NICED_WEIGHT
    share = cores * n_own * _WEIGHT / (n_own * _WEIGHT + condition.n_busy * weight)
    return min(share, n_own) / n_own


@contextlib.contextmanager
def half_a_core() -> Iterator[Path]:
    """A new cgroup with a quota of half a core; yields the file for process ids. Raises UserError without cgroups."""
    root = Path("/sys/fs/cgroup")
    legacy = next((root / name for name in ("cpu", "cpu,cpuacct") if (root / name / "tasks").exists()), None)
    group = (legacy or root) / f"perilune-{os.getpid()}"
    quota_us = round(_QUOTA_CORES * _PERIOD_US)
    try:
        group.mkdir()
    except OSError as error:
        raise UserError(group, "cgroup", error.strerror, "root, and cgroups that may be changed") from None
    try:
        if legacy is None:
            (group / "cpu.max").write_text(f"{quota_us} {_PERIOD_US}")
        else:
            (group / "cpu.cfs_period_us").write_text(str(_PERIOD_US))
            (group / "cpu.cfs_quota_us").write_text(str(quota_us))
        yield group / "cgroup.procs"
    except OSError as error:
        raise UserError(group, "cgroup", error.strerror, "the processor controller of cgroups") from None
    finally:
        with contextlib.suppress(OSError):
            group.rmdir()


@contextlib.contextmanager
def busy_processes(condition: Condition) -> Iterator[None]:
    """Other work on the machine while the block runs."""
    prefix = ["nice", "-n", str(condition.nice)] if condition.nice else []
    busy = [subprocess.Popen([*prefix, sys.executable, "-c", _BUSY]) for _ in range(condition.n_busy)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def speed(workload: str, condition: Condition, seconds: float) -> float:
    """Steps per second of a workload, in one process or one for each core."""
    with contextlib.ExitStack() as stack:
        group = stack.enter_context(half_a_core()) if condition.quota else None
        n = cores_in_affinity() if workload in PROCESSES and not condition.quota else 1
        environment = {**os.environ, **(_BEFORE if condition.before else {})}
        if not condition.before:
            # This program has set it for itself; a user's own value stays.
            environment = {name: value for name, value in environment.items() if name != "GOMP_SPINCOUNT"}
        # In the cgroup from its start: it counts its cores when it loads.
        enter = [] if group is None else ["sh", "-c", 'echo $$ > "$0" && exec "$@"', str(group)]
        command = [*enter, sys.executable, "-m", "benchmarks.shared", "--worker", workload, "--seconds", str(seconds)]
        workers = [
            subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            for _ in range(n)
        ]
        for worker in workers:
            stack.callback(worker.kill)
        for worker in workers:
            assert worker.stdout is not None
            worker.stdout.readline()
        stack.enter_context(busy_processes(condition))
        for worker in workers:
            assert worker.stdin is not None
            worker.stdin.write("run\n")
            worker.stdin.flush()
        steps = [float(worker.stdout.readline()) for worker in workers if worker.stdout is not None]
        for worker in workers:
            worker.wait()
        return sum(steps)


def work(workload: str, seconds: float) -> None:
    """A worker process: load, print a line, wait for one, run, print steps per second."""
    step = WORKLOADS[workload]()
    for _ in range(3):
        step()
    print("ready", flush=True)
    sys.stdin.readline()
    begin_s, n_steps = time.perf_counter(), 0
    while (elapsed_s := time.perf_counter() - begin_s) < seconds:
        step()
        n_steps += 1
    print(n_steps / elapsed_s, flush=True)


def main(
    workload: Annotated[list[str] | None, typer.Option(help=f"{', '.join(WORKLOADS)}. [default: all]")] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="Length of a measurement.")] = 15.0,
    rounds: Annotated[int, typer.Option(min=1, help="Measurements under each condition.")] = 3,
    worker: Annotated[str | None, typer.Option(hidden=True)] = None,
    out: Path = Path("runs/bench/shared.json"),
) -> None:
    """Run the benchmark."""
    if worker is not None:
        work(worker, seconds)
        return
    chosen = workload or list(WORKLOADS)
    for name in chosen:
        if name not in WORKLOADS:
            raise UserError("--workload", "", name, ", ".join(WORKLOADS))
    figures: dict[str, object] = {}
    for name in chosen:
        conditions = [one for one in CONDITIONS if name in SPINNING or not one.before]
        try:
            with half_a_core():
                pass
        except UserError as error:
            print(f"without the quota: {error}", file=sys.stderr)
            conditions = [one for one in conditions if not one.quota]
        speeds: dict[str, list[float]] = {one.name: [] for one in conditions}
        # Conditions take turns, since the speed of a machine changes.
        for _ in range(rounds):
            for one in conditions:
                speeds[one.name].append(speed(name, one, seconds))
                print(f"{name}, {one.name}: {speeds[one.name][-1]:.2f} steps/s", flush=True)
        found: dict[str, float] = {"alone_steps_per_s": statistics.median(speeds[ALONE.name])}
        for one in conditions[1:]:
            pairs = zip(speeds[one.name], speeds[ALONE.name], strict=True)
            ratio = statistics.median(here / alone for here, alone in pairs)
            key = one.name.replace(", ", " ").replace(" ", "_")
            found[f"{key}_ratio"] = ratio
            found[f"{key}_of_fair_share"] = ratio / fair_share(name, one)
        figures[name] = found
    write_figures(out, {"seconds": seconds, "rounds": rounds, **figures})


if __name__ == "__main__":
    run_command_line(one_command(main))
