"""The paper's experiment: render, train, evaluate, explain, and write its page. Run again to resume (`make paper`).

    python scripts/paper.py [--preset paper] [--part whole|gpu|full] [--ground pangu|lunar] [--attitude]

Every step is one of the commands that a user has, printed before it runs. A finished step is left unchanged. Part `gpu`
renders frames while networks train on finished datasets. With `--minutes`, the page shows what is done by then.
"""

import itertools
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # Not where another module imports this one.
    end_at_interrupt()

import typer

from perilune_render.config.dataset import DatasetConfig
from perilune_shared.config.resolve import resolve
from perilune_shared.errors import EXIT_INTERRUPTED, UserError
from perilune_shared.storage.files import write_text
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.train.transfer import check_start
from perilune_train.motion.config import NavigateConfig
from perilune_train.records.metrics_file import read_metrics
from perilune_train.report.paper.claimed import DETECTION

PROTOCOL = Path("configs/paper_protocol.yaml")
ATTITUDE_DEG = 1.0
"""Standard deviation of the attitude per axis in the datasets with attitude noise."""
CALIBRATED_AP = DETECTION["YOLOv3"]["ap50_paper"]
"""Validation AP of YOLOv3 without attention on the headline ground: the paper's."""
SPARSE, LUNAR = "0.1", "lunar"
"""The two ends of the curve: a tenth of the equilibrium density, and our usual ground."""
RENDER_CORE_S = 0.12
"""Core-seconds of a frame of 256 px with the engine heightfield, scene included."""
FRAME_BYTES = 75_000
"""Bytes of a frame with its labels, roughly."""


class Part(StrEnum):
    """How much of the experiment is made, and on what."""

    WHOLE = "whole"
    GPU = "gpu"
    FULL = "full"


class Ground(StrEnum):
    """The headline ground."""

    PANGU = "pangu"
    LUNAR = "lunar"


@dataclass(frozen=True)
class Sizes:
    """Sizes of a part."""

    trajectories: int
    """Detection trajectories over each ground, of `frames` frames."""
    frames: int
    """Frames of a trajectory, of detection and of navigation."""
    nav_trajectories: int
    """Navigation trajectories."""
    curve: tuple[str, ...]
    """Shares of the equilibrium density of the grounds between the sparse and our usual one."""
    epochs: int
    """Epochs of each detector on the headline ground and on the curve."""
    long_epochs: int
    """Epochs on the sparse and on our usual ground. If there are more than `epochs`, two detectors on the headline
    ground train as long, to show what epochs change."""
    curve_width: float
    """Width of the detectors on the curve, and of the lunar ones."""
    half_width: float
    """Width of the detectors that are trained with three seeds."""
    seeds: tuple[int, ...]
    """Seeds of the narrower detectors."""
    navigator_width: float
    """Width of the navigators. At half width they start from the narrower detectors of the first seed."""
    more: bool
    """Whether gates from identity on the sparse ground, and transfer from our own network, are trained too."""
    coarse_epochs: int
    """Coarse epochs of the navigators; an epoch has about 30 steps."""
    fine_epochs: int
    """Fine epochs of the navigators in the reading of the paper."""
    renderings: int = 1
    """Renderings at once beside the trainings."""
    render_workers: int | None = None
    """Processes of each rendering; None for the command's default."""
    trainings: int = 1
    """Trainings at once, beside the rendering; 1 runs one step after another."""
    benchmark_scenes: int = 0
    """Scenes of each part of the locked benchmark; 0 for none."""
    settings: dict[str, str] = field(default_factory=dict)
    """Settings over the preset and the protocol."""


_TWO_CORES = {
    "detect.batch_size": "8",
    "detect.warmup_steps": "200",
    "detect.workers": "0",
    "navigate.workers": "0",
    "navigate.stack.batch_sequences": "1",
    "navigate.stack.accumulate": "8",
    "navigate.stack.views": "4",
}
"""Settings that fit two cores and 16 GB."""
_GPU = {
    "detect.batch_size": "32",
    "detect.warmup_steps": "100",
    "detect.validate_every": "6",
    "detect.workers": "0",
    "navigate.workers": "0",
    # Two navigators and three detectors at once need 60 GB so.
    "navigate.stack.batch_sequences": "4",
    "navigate.stack.accumulate": "2",
    "navigate.stack.views": "8",
}
PARTS = {
    Part.WHOLE: Sizes(
        trajectories=30,
        frames=100,
        nav_trajectories=49,
        curve=("0.25", "0.8"),
        epochs=5,
        long_epochs=5,
        curve_width=0.5,
        half_width=0.5,
        seeds=(0, 1, 2),
        navigator_width=0.5,
        more=False,
        coarse_epochs=104,
        fine_epochs=6,
        benchmark_scenes=2,
        settings=_TWO_CORES,
    ),
    Part.GPU: Sizes(
        trajectories=30,
        frames=100,
        nav_trajectories=49,
        curve=("0.25", "0.5", "1.0"),
        epochs=12,
        long_epochs=24,
        curve_width=1.0,
        half_width=0.5,
        seeds=(0, 1, 2),
        navigator_width=1.0,
        more=True,
        coarse_epochs=160,
        fine_epochs=6,
        render_workers=14,
        trainings=4,
        settings=_GPU,
    ),
    Part.FULL: Sizes(
        trajectories=343,
        frames=100,
        nav_trajectories=49,
        curve=("0.25", "0.5", "1.0"),
        epochs=20,
        long_epochs=20,
        curve_width=1.0,
        half_width=0.5,
        seeds=(0, 1, 2),
        navigator_width=1.0,
        more=True,
        coarse_epochs=120,
        fine_epochs=20,
        trainings=2,
        benchmark_scenes=2,
        settings=_GPU | {"detect.validate_every": "1"},
    ),
}
TINY = Sizes(
    trajectories=1,
    frames=8,
    nav_trajectories=5,
    curve=("0.5",),
    epochs=1,
    long_epochs=2,
    curve_width=0.125,
    half_width=0.125,
    seeds=(0,),
    navigator_width=1.0,
    more=True,
    coarse_epochs=2,
    fine_epochs=1,
    settings={"detect.batch_size": "8", "detect.validate_every": "1", "navigate.stack.views": "1"},
)
"""Sizes with PRESET=tiny: all steps in minutes; the networks learn nothing."""


@dataclass(frozen=True)
class Step:
    """One command of the experiment, or one function of this script."""

    title: str
    """What it does."""
    command: list[str] | Callable[[], None]
    """Program and arguments, or the function."""
    done: Callable[[], bool]
    """Whether it is finished already."""
    needs: tuple[str, ...] = ()
    """Titles of the steps whose results it reads."""
    renders: bool = False
    """Whether it renders frames, in the lane of its own."""
    images: float = 0.0
    """Training images of a detector, or frames to render."""
    width: float = 1.0
    """Width of the network that is trained."""
    attention: str = "none"
    """Its attention."""


@dataclass(frozen=True)
class Experiment:
    """Names, folders and settings of one experiment."""

    preset: str
    part: Part
    ground: Ground
    attitude: bool
    darknet: Path | None
    benchmark: Path
    calibrate: bool = False

    @property
    def sizes(self) -> Sizes:
        """How much is made."""
        if self.preset == "paper":
            return PARTS[self.part]
        return replace(TINY, trainings=2) if self.part == Part.GPU else TINY

    @property
    def label(self) -> str:
        """Name of the dataset and of the folders: paper, paper-gpu, paper-tiny, paper-lunar."""
        parts = ["paper"]
        parts += [self.preset] if self.preset != "paper" else [] if self.part == Part.WHOLE else [str(self.part)]
        return "-".join([*parts, *([LUNAR] if self.ground == Ground.LUNAR else [])])

    @property
    def data(self) -> Path:
        """Folder of the rendered grounds."""
        return Path("data", self.label)

    @property
    def runs(self) -> Path:
        """Folder of the runs and of the page."""
        return Path("runs", self.label)

    @property
    def scored(self) -> Path:
        """Folder of the rendered part of the benchmark, named as `make benchmark SCENES=2` does."""
        return self.benchmark.with_name(f"{self.benchmark.name}-{self.sizes.benchmark_scenes}-scenes")

    @property
    def chosen(self) -> Path:
        """File with the density of the headline ground, if it is chosen in this experiment."""
        return self.runs / "ground.json"

    def settings(self, section: str) -> dict[str, str]:
        """Settings over the preset and the protocol."""
        sizes = self.sizes
        if section == "dataset":
            found = {"dataset.name": self.label}
            if self.preset == "paper":
                counts = {"detect": sizes.trajectories, "nav": sizes.nav_trajectories}
                for kind, count in counts.items():
                    found |= {f"dataset.{kind}.trajectories_per_scene": str(count)}
                    found |= {f"dataset.{kind}.n_frames": str(sizes.frames)}
            return found
        own = {key: value for key, value in sizes.settings.items() if key.startswith(f"{section}.")}
        if section == "detect":
            return own
        return own | {
            "navigate.stack.coarse_epochs": str(sizes.coarse_epochs),
            "navigate.stack.fine_epochs": str(sizes.fine_epochs),
        }

    def options(self, section: str, **more: str) -> list[str]:
        """Options of a command that reads this section; `more` are settings over all others."""
        pairs = self.settings(section) | {key.replace("__", "."): value for key, value in more.items()}
        sets = [text for key, value in pairs.items() for text in ("--set", f"{key}={value}")]
        return ["--preset", self.preset, "--config", str(PROTOCOL), *sets]


def program(name: str) -> list[str]:
    """How a command is started: as installed, or from its folder where nothing is installed."""
    installed = Path(sys.executable).parent / name
    if installed.is_file():
        return [str(installed)]
    module = {"perilune-render": "perilune_render.cli.main", "perilune-train": "perilune_train.cli.main"}[name]
    return [sys.executable, "-c", f"from {module} import main; main()"]


def crater_density(share: str) -> dict[str, str]:
    """Settings of the terrain: the protocol's with another density; our usual terrain for `lunar`."""
    if share == LUNAR:
        usual = resolve(DatasetConfig, "dataset", "perilune_render", "paper").terrain
        craters, relief = usual.craters, usual.relief
        return {
            "dataset__terrain__craters": _inline(craters.model_dump(mode="json")),
            "dataset__terrain__relief": _inline(relief.model_dump(mode="json")),
        }
    span = _inline({"low": float(share), "high": float(share)})
    return {"dataset__terrain__craters__equilibrium_share": span}


def _inline(values: Any) -> str:
    return json.dumps(values).replace('"', "")


def steps(one: Experiment) -> list[Step]:
    """All steps, the most important first, since a run with a limit on its time may not reach the last."""
    sizes, ground = one.sizes, "headline"
    curve = [step for share in sizes.curve for step in _on_curve(one, share)] if one.ground == Ground.PANGU else []
    # The networks on the two ends of the curve are points of it only if they are as large and train as long.
    if curve and (sizes.curve_width != 1.0 or sizes.long_epochs != sizes.epochs):
        curve.append(_detector(one, SPARSE, f"curve-{SPARSE}", "none", sizes.curve_width))
    if curve and sizes.long_epochs != sizes.epochs:
        curve.append(_detector(one, LUNAR, f"curve-{LUNAR}", "none", sizes.curve_width))
    first = [*curve, _calibration(one)] if one.calibrate else []
    needs = ("choose the headline ground",) if one.calibrate else ()

    longer = {"detect__epochs": str(sizes.long_epochs)}

    def seeds(folder: str, attention: str) -> list[Step]:
        return [
            _detector(one, ground, f"{folder}-half-{seed}", attention, sizes.half_width, detect__seed=str(seed))
            for seed in sizes.seeds
        ]

    navigators = [("darknet53-lstm", "yolov3", "none"), ("attention-darknet53-lstm", "attention-yolov3", "cbam")]
    whole = sizes.navigator_width == 1.0
    half = [] if whole else [*seeds("yolov3", "none")[:1], *seeds("attention-yolov3", "cbam")[:1]]

    headline = [
        _render(one, ground, "detect", headline_density(one), needs),
        _render(one, ground, "nav", headline_density(one), needs),
        _detector(one, ground, "yolov3", "none", 1.0),
        _detector(one, ground, "attention-yolov3", "cbam", 1.0),
        *half,
        *(_navigator(one, *words, "pose") for words in navigators),
        _explanation(one),
    ]
    identity = _detector(one, ground, "attention-identity", "cbam_identity", 1.0)
    sparse = [*_on_curve(one, SPARSE), _detector(one, SPARSE, "sparse-attention-yolov3", "cbam", 1.0, **longer)]
    lunar = [
        *_on_curve(one, LUNAR),
        _detector(one, LUNAR, "lunar-attention-identity", "cbam_identity", sizes.curve_width, **longer),
    ]
    if one.ground == Ground.LUNAR:
        sparse, lunar = [], []
    long = [
        _detector(one, ground, "long-yolov3", "none", 1.0, **longer),
        _detector(one, ground, "long-attention-yolov3", "cbam", 1.0, **longer),
    ]
    sparse_identity = _detector(one, SPARSE, "sparse-attention-identity", "cbam_identity", 1.0, **longer)
    found = [
        *first,
        *headline,
        identity,
        *sparse,
        *seeds("yolov3", "none")[len(half) // 2 :],
        *seeds("attention-yolov3", "cbam")[len(half) // 2 :],
        *seeds("attention-identity", "cbam_identity"),
        *lunar,
        *(_attitude(one, navigators) if one.attitude else []),
        *(long if sizes.long_epochs > sizes.epochs else []),
        *([] if first else curve),
        *(_navigator(one, *words, "motion") for words in navigators),
        *([sparse_identity] if sizes.more and sparse else []),
        *_transfer(one),
        *_benchmark_steps(one),
    ]
    return [*found, _page(one)]


def _render(one: Experiment, ground: str, kind: str, density: dict[str, str], needs: tuple[str, ...]) -> Step:
    out = one.data / ground
    command = [*program("perilune-render"), "dataset", "--kind", kind, *one.options("dataset", **density)]
    command += [] if one.sizes.render_workers is None else ["--workers", str(one.sizes.render_workers)]
    count = one.sizes.trajectories if kind == "detect" else one.sizes.nav_trajectories
    title = f"render {ground}" if kind == "detect" else f"render {ground}, navigation"
    return Step(
        title,
        [*command, "--out", str(out)],
        _rendered(out / kind),
        needs,
        renders=True,
        images=count * one.sizes.frames,
    )


def _detector(one: Experiment, ground: str, folder: str, attention: str, width: float, **more: str) -> Step:
    """Training of a detector on a ground, into detect/<folder>."""
    width = 0.125 if one.preset == "tiny" else width
    settings = {"detect__attention": attention, "detect__width": str(width)}
    options = one.options("detect", **settings, **({"detect__epochs": str(one.sizes.epochs)} | more))
    command = [*program("perilune-train"), "detect", "train", *options, "--dataset", str(one.data / ground / "detect")]
    epochs = int(more.get("detect__epochs", one.sizes.epochs))
    images = 0.8 * one.sizes.trajectories * one.sizes.frames * epochs
    return Step(
        f"train {folder}",
        [*command, "--out", str(one.runs), "--name", folder],
        _finished(one.runs / "detect" / folder),
        (f"render {ground}",),
        images=images,
        width=width,
        attention=attention,
    )


def _on_curve(one: Experiment, share: str) -> list[Step]:
    """A ground of the curve, and YOLOv3 without attention on it."""
    folder = {SPARSE: "sparse-yolov3", LUNAR: "lunar-yolov3"}.get(share, f"curve-{share}")
    width = 1.0 if share == SPARSE else one.sizes.curve_width
    longer = {"detect__epochs": str(one.sizes.long_epochs)} if share in (SPARSE, LUNAR) else {}
    return [
        _render(one, share, "detect", crater_density(share), ()),
        _detector(one, share, folder, "none", width, **longer),
    ]


def _calibration(one: Experiment) -> Step:
    runs = {share: one.runs / "detect" / f"curve-{share}" for share in one.sizes.curve}

    def choose() -> None:
        found = {float(share): float(str(read_metrics(run)["val/ap50_paper"])) for share, run in runs.items()}
        share = share_at(found, CALIBRATED_AP)
        record = {"equilibrium_share": share, "validation_ap": {f"{key:g}": value for key, value in found.items()}}
        write_text(one.chosen, json.dumps(record, indent=2) + "\n")
        print(f"headline ground: equilibrium_share {share:g}, by validation AP {found}", flush=True)

    needs = tuple(f"train curve-{share}" for share in one.sizes.curve)
    return Step("choose the headline ground", choose, one.chosen.is_file, needs)


def share_at(ap_by_share: dict[float, float], ap: float) -> float:
    """Share of the equilibrium density at which the AP has a value: linear in the logarithm of the share, between the
    two points around the value or beyond the last two; from 0.1 to 1.7, with two digits."""
    points = sorted(ap_by_share.items())
    if len(points) == 1:
        return points[0][0]
    pairs = list(itertools.pairwise(points))
    around = [pair for pair in pairs if pair[0][1] >= ap >= pair[1][1]]
    (low, first), (high, second) = around[0] if around else pairs[0] if ap > points[0][1] else pairs[-1]
    part = (first - ap) / (first - second) if first > second else 0.5
    share = math.exp(math.log(low) + part * (math.log(high) - math.log(low)))
    return float(f"{min(max(share, 0.1), 1.7):.2g}")


def headline_share(one: Experiment) -> str:
    """Share of the equilibrium density of the headline ground, or `lunar`."""
    if one.ground == Ground.LUNAR:
        return LUNAR
    if one.calibrate and one.chosen.is_file():
        return f"{json.loads(one.chosen.read_text(encoding='utf-8'))['equilibrium_share']:g}"
    dataset = resolve(DatasetConfig, "dataset", "perilune_render", one.preset, PROTOCOL)
    return f"{dataset.terrain.craters.equilibrium_share.low:g}"


def headline_density(one: Experiment) -> dict[str, str]:
    """Settings of the headline ground that differ from the protocol's."""
    chosen = one.ground == Ground.LUNAR or (one.calibrate and one.chosen.is_file())
    return crater_density(headline_share(one)) if chosen else {}


def _explanation(one: Experiment) -> Step:
    attended = one.runs / "detect" / "attention-yolov3" / "checkpoints" / "best.ckpt"
    navigator = one.runs / "navigate" / "attention-darknet53-lstm-stack" / "checkpoints" / "best.ckpt"
    command = [*program("perilune-train"), "explain", "--preset", one.preset, "--dataset", str(one.data / "headline")]
    command += ["--out", str(one.runs), "--name", "attention"]
    command += ["--detector", str(attended), "--navigator", str(navigator)]
    needs = ("train attention-yolov3", "train attention-darknet53-lstm")
    return Step("explain", command, _finished(one.runs / "explain" / "attention"), needs)


def _attitude(one: Experiment, navigators: list[tuple[str, str, str]]) -> list[Step]:
    """Navigators over descents with attitude noise, on the backbones of the descents without."""
    noise = {"dataset__nav__flight__attitude_sigma_deg": str(ATTITUDE_DEG)}
    needs = ("choose the headline ground",) if one.calibrate else ()
    rendered = _render(one, "attitude", "nav", headline_density(one) | noise, needs)
    return [rendered, *(_navigator(one, *words, "attitude") for words in navigators)]


def _navigator(one: Experiment, folder: str, detector: str, attention: str, reading: str) -> Step:
    """Training of a navigator in one of the readings pose, motion, or attitude (the pose with attitude noise)."""
    name = folder if reading == "pose" else f"{folder}-{reading}"
    sizes = one.sizes
    detector = detector if sizes.navigator_width == 1.0 else f"{detector}-half-{sizes.seeds[0]}"
    width = 0.125 if one.preset == "tiny" else sizes.navigator_width
    backbone = one.runs / "detect" / detector / "checkpoints" / "best.ckpt"
    target, ground = (
        ("motion" if reading == "motion" else "pose"),
        ("attitude" if reading == "attitude" else "headline"),
    )
    settings = {"navigate__stack__attention": attention, "navigate__stack__target": target}
    settings |= {"navigate__detector": str(backbone), "navigate__stack__width": str(width)}
    if reading == "motion":
        settings |= {"navigate__stack__fine_epochs": "1", "navigate__stack__views": "0"}
    options = one.options("navigate", **settings)
    command = [*program("perilune-train"), "navigate", "train", *options, "--dataset", str(one.data / ground / "nav")]
    return Step(
        f"train {name}",
        [*command, "--out", str(one.runs), "--name", name],
        _finished(one.runs / "navigate" / f"{name}-stack"),
        (f"train {detector}", f"render {ground}, navigation"),
        width=width,
        attention=attention,
    )


def _transfer(one: Experiment) -> list[Step]:
    """Detectors that start from YOLOv3 of COCO, or from our own on our usual ground in its place; first frozen."""
    width = 1.0 if one.darknet is not None else one.sizes.curve_width
    if one.darknet is None and (one.ground == Ground.LUNAR or not one.sizes.more):
        return []
    start = str(one.darknet or one.runs / "detect" / "lunar-yolov3" / "checkpoints" / "best.ckpt")
    more = {"detect__init_from": start, "detect__frozen_epochs": str(min(2, one.sizes.epochs - 1))}
    found = []
    for folder, attention in (("transfer-yolov3", "none"), ("transfer-attention-yolov3", "cbam")):
        step = _detector(one, "headline", folder, attention, width, **more)
        needs = step.needs if one.darknet is not None else (*step.needs, "train lunar-yolov3")
        found.append(replace(step, needs=needs))
    return found


def _benchmark_steps(one: Experiment) -> list[Step]:
    """Scores of the detectors on the locked benchmark."""
    if one.preset != "paper" or not one.sizes.benchmark_scenes:
        return []
    command = ["scripts/render-benchmark", "detect", str(one.scored), str(one.sizes.benchmark_scenes)]
    parts = [one.scored / f"benchmark-detect-{part}" for part in ("highland", "mare", "camera")]
    found = [Step("render the benchmark", command, _rendered(*parts), renders=True)]
    for folder in ("yolov3", "attention-yolov3"):
        out = one.runs / "benchmark" / folder
        command = [*program("perilune-train"), "detect", "benchmark", "--run", str(one.runs / "detect" / folder)]
        command += ["--data", str(one.scored), "--out", str(out)]
        done = (out / "benchmark.json").is_file
        found.append(Step(f"benchmark {folder}", command, done, (f"train {folder}", "render the benchmark")))
    return found


def _page(one: Experiment) -> Step:
    sizes = one.sizes
    about = [f"preset `{one.preset}`, part `{one.part}`"]
    about += [f"attitude noise: {ATTITUDE_DEG:g} degree per axis, where named"] if one.attitude else []
    about += [
        f"{sizes.trajectories * sizes.frames} detection frames over each ground (the paper: 34,300), "
        f"{sizes.nav_trajectories} navigation trajectories of {sizes.frames} frames (the paper: 49 of 100); "
        f"{sizes.epochs} epochs of each detector on the headline ground and the curve, {sizes.long_epochs} on the "
        "sparse and on our usual ground"
    ]
    command = [*program("perilune-train"), "paper", "--runs", str(one.runs)]
    command += ["--dataset", str(one.data / "headline" / "detect"), "--headline-share", headline_share(one)]
    return Step("page", [*command, *[text for line in about for text in ("--about", line)]], lambda: False)


def _rendered(*datasets: Path) -> Callable[[], bool]:
    return lambda: all(map(_complete, datasets))


def _complete(dataset: Path) -> bool:
    path = dataset / "dataset.json"
    return path.is_file() and json.loads(path.read_text(encoding="utf-8")).get("complete") is True


def _finished(run: Path) -> Callable[[], bool]:
    def whole() -> bool:
        # Importing torch takes seconds; most runs of a plan are not there yet.
        if not (run / "metrics.json").is_file():
            return False
        from perilune_train.training.runs import RunFolder

        return RunFolder(run).finished

    return whole


def estimate(one: Experiment, plan: list[Step]) -> dict[str, float]:
    """Seconds of the long steps that are left, from a few training steps on this machine, by title."""
    from perilune_train.report.paper.probe import detect_seconds, navigate_seconds

    size_px = int(resolve(DatasetConfig, "dataset", "perilune_render", one.preset, PROTOCOL).camera.width_px)
    detect = resolve(DetectConfig, "detect", "perilune_train", one.preset, PROTOCOL, _sets(one, "detect"))
    navigate = resolve(NavigateConfig, "navigate", "perilune_train", one.preset, PROTOCOL, _sets(one, "navigate"))
    cores = len(os.sched_getaffinity(0))
    per_image: dict[tuple[float, str], float] = {}
    found: dict[str, float] = {}
    for step in plan:
        if step.done():
            continue
        if step.renders and step.images:
            found[step.title] = RENDER_CORE_S * step.images / cores
        elif step.images:
            kind = (step.width, step.attention)
            if kind not in per_image:
                config = detect.model_copy(update={"width": step.width, "attention": step.attention})
                per_image[kind] = detect_seconds(config, size_px)
            found[step.title] = per_image[kind] * step.images
        elif "lstm" in step.title:
            own = navigate.stack.model_copy(update={"attention": step.attention, "width": step.width})
            seconds = navigate_seconds(navigate.model_copy(update={"stack": own}))
            pairs = 0.8 * one.sizes.nav_trajectories * one.sizes.frames
            # Features of the coarse stage are computed once, forward only.
            motion = step.title.endswith("motion")
            fine, views = (1, 0) if motion else (one.sizes.fine_epochs, navigate.stack.views)
            found[step.title] = seconds * pairs * (fine + (1 + views) / 3)
    return found


def _sets(one: Experiment, section: str) -> tuple[str, ...]:
    return tuple(f"{key}={value}" for key, value in one.settings(section).items())


def check_disk(one: Experiment, plan: list[Step]) -> None:
    """Raise UserError before the first frame if the frames that are left do not fit on the disk."""
    folder = one.data
    while not folder.exists():
        folder = folder.parent
    needed = sum(FRAME_BYTES * step.images for step in plan if step.renders and not step.done())
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise UserError(one.data, "free disk", f"{free / 1e9:.1f} GB", f"at least {needed / 1e9:.1f} GB for the frames")


def main(
    preset: Annotated[str, typer.Option(help="Preset of sizes: paper, or tiny for a trial.")] = "paper",
    part: Annotated[
        Part, typer.Option(help="whole (two cores, 20 core-hours), gpu (minutes), full (all frames of the paper).")
    ] = Part.WHOLE,
    ground: Annotated[
        Ground, typer.Option(help="Headline ground: as difficult as the paper's, or our usual one.")
    ] = Ground.PANGU,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Choose the density of the headline ground again, on validation.")
    ] = False,
    attitude: Annotated[
        bool, typer.Option("--attitude", help="Also train navigators over descents with attitude noise.")
    ] = False,
    darknet: Annotated[Path | None, typer.Option(help="YOLOv3's weights of COCO (yolov3.weights).")] = None,
    benchmark: Annotated[Path, typer.Option(help="Folder of the rendered locked benchmark.")] = Path("data/benchmark"),
    minutes: Annotated[
        float | None, typer.Option(min=0.1, help="Stop after this time, and write the page from what is done.")
    ] = None,
) -> None:
    """Run all steps."""
    if preset not in ("paper", "tiny"):
        raise UserError("--preset", "", preset, "paper or tiny")
    if darknet is not None:
        check_start(darknet)
    if calibrate and ground == Ground.LUNAR:
        raise UserError("--calibrate", "--ground", ground, f"{Ground.PANGU}, whose density is chosen")
    one = Experiment(preset, part, ground, attitude, darknet, benchmark, calibrate)
    plan = steps(one)
    check_disk(one, plan)
    print(f"{one.runs}: {len(plan)} steps", flush=True)
    if minutes is None:
        expected = estimate(one, plan)
        for title, seconds in expected.items():
            print(f"  {title}: about {_hours(seconds)}")
        print(f"  long steps together: about {_hours(sum(expected.values()))}; Ctrl-C stops, run again to resume")
    else:
        expected = {}
    deadline = math.inf if minutes is None else time.monotonic() + 60 * minutes
    run_all(one, expected, deadline)
    print(f"{one.runs}: paper.md")


@dataclass
class Running:
    """A step that runs."""

    step: Step
    process: subprocess.Popen
    log: Path | None
    started: float


def run_all(one: Experiment, expected: dict[str, float], deadline: float) -> None:
    """Run the steps that are left: one after another, or, with several trainings at once, as soon as they can.

    Raises typer.Exit with the exit code of the first step that fails, after the others have been stopped. At the
    deadline running steps are stopped as by Ctrl-C, and only the page is written.
    """
    running: list[Running] = []
    together = one.sizes.trainings > 1
    failed: dict[str, int] = {}
    began = time.monotonic()
    try:
        while True:
            plan = steps(one)
            titles = {step.title for step in plan if not step.done()}
            # A step whose needs failed never starts; the page is written last.
            page = plan[-1]
            left = [step for step in plan[:-1] if not step.done() and step.title not in failed]
            late = time.monotonic() > deadline
            busy = {each.step.title for each in running}
            ready = [s for s in left if s.title not in busy and not any(need in titles for need in s.needs)]
            if not running and (not ready or late):
                break
            if not late:
                for step in ready:
                    lane = [each for each in running if each.step.renders == step.renders or not together]
                    most = one.sizes.renderings if step.renders else one.sizes.trainings
                    if len(lane) < (most if together else 1):
                        running += _start(one, step, together, began, expected)
                        if callable(step.command) or not together:
                            break
            _wait(running, failed, together, deadline)
            if failed and not together:
                raise typer.Exit(next(iter(failed.values())))
    except KeyboardInterrupt:
        if together:
            _stop(running)
            raise
        # The terminal has stopped the step too, which has printed how to resume.
        _end(running)
        sys.stdout.flush()
        os._exit(EXIT_INTERRUPTED)
    for title, code in failed.items():
        print(f"failed with code {code}: {title}; see {_log(one, title)}", flush=True)
    _run(page)
    if failed:
        raise typer.Exit(next(iter(failed.values())))


def _start(one: Experiment, step: Step, together: bool, began: float, expected: dict[str, float]) -> list[Running]:
    left = sum(seconds for title, seconds in expected.items() if title != step.title)
    rest = f", about {_hours(left + expected.get(step.title, 0))} left" if expected else ""
    print(f"{_hours(time.monotonic() - began)}: {step.title}{rest}", flush=True)
    expected.pop(step.title, None)
    if callable(step.command):
        step.command()
        return []
    if not together:
        print("  " + " ".join(_shown(word) for word in step.command), flush=True)
        return [Running(step, subprocess.Popen(step.command), None, time.monotonic())]
    log = _log(one, step.title)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w", encoding="utf-8") as file:
        file.write(" ".join(_shown(word) for word in step.command) + "\n")
        file.flush()
        # In a session of its own: Ctrl-C reaches it through this script, once.
        process = subprocess.Popen(step.command, stdout=file, stderr=subprocess.STDOUT, start_new_session=True)
    return [Running(step, process, log, time.monotonic())]


def _wait(running: list[Running], failed: dict[str, int], together: bool, deadline: float) -> None:
    """Wait until a step ends or the deadline has passed."""
    while running:
        if together and time.monotonic() > deadline:
            _stop(running)
        ended = [each for each in running if each.process.poll() is not None]
        for each in ended:
            running.remove(each)
            code = each.process.returncode
            if code and time.monotonic() <= deadline:
                failed[each.step.title] = 128 - code if code < 0 else code
            elif together and not code:
                print(f"  done in {_hours(time.monotonic() - each.started)}: {each.step.title}", flush=True)
        if ended:
            return
        if not together and time.monotonic() > deadline:
            _stop(running)
        time.sleep(0.2)


def _end(running: list[Running]) -> None:
    """Wait for steps that were stopped together with this script; stop them if they were not."""
    for each in running:
        try:
            each.process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            _stop([each])


def _stop(running: list[Running]) -> None:
    """Stop steps as Ctrl-C does, so that they can be resumed."""
    for each in running:
        if each.process.poll() is None:
            each.process.send_signal(signal.SIGINT)
    for each in running:
        try:
            each.process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            each.process.kill()
            each.process.wait()


def _run(step: Step) -> None:
    assert not callable(step.command)
    print(f"{step.title}\n  " + " ".join(_shown(word) for word in step.command), flush=True)
    done = subprocess.run(step.command, check=False)
    if done.returncode:
        raise typer.Exit(done.returncode)


def _log(one: Experiment, title: str) -> Path:
    return one.runs / "logs" / (re.sub(r"[^a-z0-9.-]+", "-", title.lower()) + ".log")


def _shown(word: str) -> str:
    word = word.removeprefix(f"{Path(sys.executable).parent}/")
    return f"'{word}'" if re.search(r"[\s\[\]{}]", word) else word


def _hours(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 3600:.1f} hours" if seconds >= 3600 else f"{seconds / 60:.0f} minutes"


if __name__ == "__main__":
    from perilune_shared.console.command_line import run_command_line

    app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
    app.command()(main)
    # Longer than for the commands that it starts, which print how to resume.
    run_command_line(app, ended_after_s=2.5)
