"""Run the paper's experiment: render, train, evaluate, explain, and write its page. Run again to resume (`make paper`).

    python scripts/paper.py [--preset paper] [--part whole|gpu|full] [--ground pangu|lunar] [--attitude]

Nearly every step is a command that users can run, and is printed before it runs. Finished steps are skipped. Part `gpu`
renders frames while networks train on finished datasets. With `--minutes`, the experiment stops after that time, and
the page shows the finished steps.

A ground is the terrain under the frames of one dataset. The grounds differ in crater density: `equilibrium_share`, a
share of the equilibrium density. The headline ground is the one on which the experiment is compared with the paper. The
curve is the AP of YOLOv3 without attention over the crater density.
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
    # An import by another module must not change how Ctrl-C works.
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
"""The paper's AP of YOLOv3 without attention. With --calibrate, the headline ground is chosen so that our validation AP
equals it."""
SPARSE, LUNAR = "0.1", "lunar"
"""The ends of the curve: a ground with a tenth of the equilibrium density, and perilune's usual ground."""
RENDER_CORE_S = 0.12
"""Core-seconds to render a frame of 256 px with the engine heightfield, including the generation of the scene."""
FRAME_BYTES = 75_000
"""Approximate size of a frame with its labels, bytes."""


class Part(StrEnum):
    """Part of the experiment, chosen for a machine: two cores, a GPU, or all frames of the paper."""

    WHOLE = "whole"
    GPU = "gpu"
    FULL = "full"


class Ground(StrEnum):
    """Kind of the headline ground: as difficult as the paper's, which PANGU rendered, or our usual lunar ground."""

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
    """Crater densities of the grounds between the ends of the curve, as shares of the equilibrium density."""
    epochs: int
    """Epochs of each detector on the headline ground and on the curve."""
    long_epochs: int
    """Epochs on the sparse ground and on our usual ground. If it is larger than `epochs`, two further detectors also
    train for this number of epochs on the headline ground, to show the effect of the number of epochs."""
    curve_width: float
    """Width of the detectors on the curve and on the lunar ground."""
    half_width: float
    """Width of the narrower detectors, which are trained with several random seeds."""
    seeds: tuple[int, ...]
    """Random seeds of the narrower detectors."""
    navigator_width: float
    """Width of the navigators. If it is not 1, they start from the narrower detectors of the first seed."""
    more: bool
    """Whether to run two further trainings: identity-initialised gates on the sparse ground, and transfer from our
    detector of the usual ground."""
    coarse_epochs: int
    """Coarse epochs of the navigators; an epoch has about 30 steps."""
    fine_epochs: int
    """Fine epochs of the navigators that estimate poses, as the paper's navigators do."""
    renderings: int = 1
    """Number of simultaneous renderings, if there are several simultaneous trainings."""
    render_workers: int | None = None
    """Processes of each rendering; None for the command's default."""
    trainings: int = 1
    """Number of simultaneous trainings. With 1, all steps, renderings too, run one after another."""
    benchmark_scenes: int = 0
    """Scenes of each part of the locked benchmark; 0 skips the benchmark."""
    settings: dict[str, str] = field(default_factory=dict)
    """Settings that override the preset and the protocol."""


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
    # With these sizes, two navigators and three detectors together need 60 GB.
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
    """What the step does."""
    command: list[str] | Callable[[], None]
    """Program and arguments, or the function."""
    done: Callable[[], bool]
    """Returns whether the step is finished."""
    needs: tuple[str, ...] = ()
    """Titles of the steps whose results this step reads."""
    renders: bool = False
    """Whether the step renders frames. Simultaneous renderings and trainings have separate limits."""
    images: float = 0.0
    """Number of training images over all epochs of a detector, or of frames to render."""
    width: float = 1.0
    """Width of the network that is trained."""
    attention: str = "none"
    """Attention of the network that is trained."""


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
        """Sizes of this preset and part."""
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
        """Folder of the benchmark's first scenes, with the name that `make benchmark SCENES=2` gives it."""
        return self.benchmark.with_name(f"{self.benchmark.name}-{self.sizes.benchmark_scenes}-scenes")

    @property
    def chosen(self) -> Path:
        """File with the density of the headline ground, if it is chosen in this experiment."""
        return self.runs / "ground.json"

    def settings(self, section: str) -> dict[str, str]:
        """Settings that override the preset and the protocol."""
        sizes = self.sizes
        if section == "dataset":
            values = {"dataset.name": self.label}
            if self.preset == "paper":
                counts = {"detect": sizes.trajectories, "nav": sizes.nav_trajectories}
                for kind, count in counts.items():
                    values |= {f"dataset.{kind}.trajectories_per_scene": str(count)}
                    values |= {f"dataset.{kind}.n_frames": str(sizes.frames)}
            return values
        section_settings = {key: value for key, value in sizes.settings.items() if key.startswith(f"{section}.")}
        if section == "detect":
            return section_settings
        return section_settings | {
            "navigate.stack.coarse_epochs": str(sizes.coarse_epochs),
            "navigate.stack.fine_epochs": str(sizes.fine_epochs),
        }

    def options(self, section: str, **more: str) -> list[str]:
        """Options of a command that reads this section; `more` are settings that override all others."""
        pairs = self.settings(section) | {key.replace("__", "."): value for key, value in more.items()}
        sets = [text for key, value in pairs.items() for text in ("--set", f"{key}={value}")]
        return ["--preset", self.preset, "--config", str(PROTOCOL), *sets]


def program(name: str) -> list[str]:
    """Program and arguments that start a command: the installed program, or the module if it is not installed."""
    installed = Path(sys.executable).parent / name
    if installed.is_file():
        return [str(installed)]
    module = {"perilune-render": "perilune_render.cli.main", "perilune-train": "perilune_train.cli.main"}[name]
    return [sys.executable, "-c", f"from {module} import main; main()"]


def crater_density(share: str) -> dict[str, str]:
    """Settings of the terrain: the protocol's terrain with another crater density, or our usual terrain for `lunar`."""
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


def steps(experiment: Experiment) -> list[Step]:
    """All steps, the most important first, since a run with a time limit may not reach the last steps."""
    sizes, ground = experiment.sizes, "headline"
    curve = (
        [step for share in sizes.curve for step in _on_curve(experiment, share)]
        if experiment.ground == Ground.PANGU
        else []
    )
    # Networks at the ends of the curve are comparable only if they are as large and train as long as the others.
    if curve and (sizes.curve_width != 1.0 or sizes.long_epochs != sizes.epochs):
        curve.append(_detector(experiment, SPARSE, f"curve-{SPARSE}", "none", sizes.curve_width))
    if curve and sizes.long_epochs != sizes.epochs:
        curve.append(_detector(experiment, LUNAR, f"curve-{LUNAR}", "none", sizes.curve_width))
    first = [*curve, _calibration(experiment)] if experiment.calibrate else []
    needs = ("choose the headline ground",) if experiment.calibrate else ()

    longer = {"detect__epochs": str(sizes.long_epochs)}

    def seeds(folder: str, attention: str) -> list[Step]:
        return [
            _detector(experiment, ground, f"{folder}-half-{seed}", attention, sizes.half_width, detect__seed=str(seed))
            for seed in sizes.seeds
        ]

    navigators = [("darknet53-lstm", "yolov3", "none"), ("attention-darknet53-lstm", "attention-yolov3", "cbam")]
    whole = sizes.navigator_width == 1.0
    half = [] if whole else [*seeds("yolov3", "none")[:1], *seeds("attention-yolov3", "cbam")[:1]]

    headline = [
        _render(experiment, ground, "detect", headline_density(experiment), needs),
        _render(experiment, ground, "nav", headline_density(experiment), needs),
        _detector(experiment, ground, "yolov3", "none", 1.0),
        _detector(experiment, ground, "attention-yolov3", "cbam", 1.0),
        *half,
        *(_navigator(experiment, *words, "pose") for words in navigators),
        _explanation(experiment),
    ]
    identity = _detector(experiment, ground, "attention-identity", "cbam_identity", 1.0)
    sparse = [
        *_on_curve(experiment, SPARSE),
        _detector(experiment, SPARSE, "sparse-attention-yolov3", "cbam", 1.0, **longer),
    ]
    lunar = [
        *_on_curve(experiment, LUNAR),
        _detector(experiment, LUNAR, "lunar-attention-identity", "cbam_identity", sizes.curve_width, **longer),
    ]
    if experiment.ground == Ground.LUNAR:
        sparse, lunar = [], []
    long = [
        _detector(experiment, ground, "long-yolov3", "none", 1.0, **longer),
        _detector(experiment, ground, "long-attention-yolov3", "cbam", 1.0, **longer),
    ]
    sparse_identity = _detector(experiment, SPARSE, "sparse-attention-identity", "cbam_identity", 1.0, **longer)
    ordered = [
        *first,
        *headline,
        identity,
        *sparse,
        *seeds("yolov3", "none")[len(half) // 2 :],
        *seeds("attention-yolov3", "cbam")[len(half) // 2 :],
        *seeds("attention-identity", "cbam_identity"),
        *lunar,
        *(_attitude(experiment, navigators) if experiment.attitude else []),
        *(long if sizes.long_epochs > sizes.epochs else []),
        *([] if first else curve),
        *(_navigator(experiment, *words, "motion") for words in navigators),
        *([sparse_identity] if sizes.more and sparse else []),
        *_transfer(experiment),
        *_benchmark_steps(experiment),
    ]
    return [*ordered, _page(experiment)]


def _render(experiment: Experiment, ground: str, kind: str, density: dict[str, str], needs: tuple[str, ...]) -> Step:
    out = experiment.data / ground
    command = [*program("perilune-render"), "dataset", "--kind", kind, *experiment.options("dataset", **density)]
    command += [] if experiment.sizes.render_workers is None else ["--workers", str(experiment.sizes.render_workers)]
    count = experiment.sizes.trajectories if kind == "detect" else experiment.sizes.nav_trajectories
    title = f"render {ground}" if kind == "detect" else f"render {ground}, navigation"
    return Step(
        title,
        [*command, "--out", str(out)],
        _rendered(out / kind),
        needs,
        renders=True,
        images=count * experiment.sizes.frames,
    )


def _detector(experiment: Experiment, ground: str, folder: str, attention: str, width: float, **more: str) -> Step:
    """Train a detector on a ground; the run is detect/<folder>."""
    width = 0.125 if experiment.preset == "tiny" else width
    settings = {"detect__attention": attention, "detect__width": str(width)}
    options = experiment.options("detect", **settings, **({"detect__epochs": str(experiment.sizes.epochs)} | more))
    command = [
        *program("perilune-train"),
        "detect",
        "train",
        *options,
        "--dataset",
        str(experiment.data / ground / "detect"),
    ]
    epochs = int(more.get("detect__epochs", experiment.sizes.epochs))
    images = 0.8 * experiment.sizes.trajectories * experiment.sizes.frames * epochs
    return Step(
        f"train {folder}",
        [*command, "--out", str(experiment.runs), "--name", folder],
        _finished(experiment.runs / "detect" / folder),
        (f"render {ground}",),
        images=images,
        width=width,
        attention=attention,
    )


def _on_curve(experiment: Experiment, share: str) -> list[Step]:
    """Render a ground of the curve, and train YOLOv3 without attention on it."""
    folder = {SPARSE: "sparse-yolov3", LUNAR: "lunar-yolov3"}.get(share, f"curve-{share}")
    width = 1.0 if share == SPARSE else experiment.sizes.curve_width
    longer = {"detect__epochs": str(experiment.sizes.long_epochs)} if share in (SPARSE, LUNAR) else {}
    return [
        _render(experiment, share, "detect", crater_density(share), ()),
        _detector(experiment, share, folder, "none", width, **longer),
    ]


def _calibration(experiment: Experiment) -> Step:
    runs = {share: experiment.runs / "detect" / f"curve-{share}" for share in experiment.sizes.curve}

    def choose() -> None:
        ap_by_share = {float(share): float(str(read_metrics(run)["val/ap50_paper"])) for share, run in runs.items()}
        share = share_at(ap_by_share, CALIBRATED_AP)
        record = {
            "equilibrium_share": share,
            "validation_ap": {f"{key:g}": value for key, value in ap_by_share.items()},
        }
        write_text(experiment.chosen, json.dumps(record, indent=2) + "\n")
        print(f"headline ground: equilibrium_share {share:g}, by validation AP {ap_by_share}", flush=True)

    needs = tuple(f"train curve-{share}" for share in experiment.sizes.curve)
    return Step("choose the headline ground", choose, experiment.chosen.is_file, needs)


def share_at(ap_by_share: dict[float, float], ap: float) -> float:
    """Share of the equilibrium density (0.1 to 1.7) at which the AP has the value `ap`, rounded to two digits.

    The AP is interpolated linearly over the logarithm of the share, or extrapolated from the nearest two points.
    """
    points = sorted(ap_by_share.items())
    if len(points) == 1:
        return points[0][0]
    pairs = list(itertools.pairwise(points))
    around = [pair for pair in pairs if pair[0][1] >= ap >= pair[1][1]]
    (low, first), (high, second) = around[0] if around else pairs[0] if ap > points[0][1] else pairs[-1]
    part = (first - ap) / (first - second) if first > second else 0.5
    share = math.exp(math.log(low) + part * (math.log(high) - math.log(low)))
    return float(f"{min(max(share, 0.1), 1.7):.2g}")


def headline_share(experiment: Experiment) -> str:
    """Share of the equilibrium density of the headline ground, or `lunar`."""
    if experiment.ground == Ground.LUNAR:
        return LUNAR
    if experiment.calibrate and experiment.chosen.is_file():
        return f"{json.loads(experiment.chosen.read_text(encoding='utf-8'))['equilibrium_share']:g}"
    dataset = resolve(DatasetConfig, "dataset", "perilune_render", experiment.preset, PROTOCOL)
    return f"{dataset.terrain.craters.equilibrium_share.low:g}"


def headline_density(experiment: Experiment) -> dict[str, str]:
    """Settings of the headline ground that differ from the settings of the protocol."""
    chosen = experiment.ground == Ground.LUNAR or (experiment.calibrate and experiment.chosen.is_file())
    return crater_density(headline_share(experiment)) if chosen else {}


def _explanation(experiment: Experiment) -> Step:
    attended = experiment.runs / "detect" / "attention-yolov3" / "checkpoints" / "best.ckpt"
    navigator = experiment.runs / "navigate" / "attention-darknet53-lstm-stack" / "checkpoints" / "best.ckpt"
    command = [
        *program("perilune-train"),
        "explain",
        "--preset",
        experiment.preset,
        "--dataset",
        str(experiment.data / "headline"),
    ]
    command += ["--out", str(experiment.runs), "--name", "attention"]
    command += ["--detector", str(attended), "--navigator", str(navigator)]
    needs = ("train attention-yolov3", "train attention-darknet53-lstm")
    return Step("explain", command, _finished(experiment.runs / "explain" / "attention"), needs)


def _attitude(experiment: Experiment, navigators: list[tuple[str, str, str]]) -> list[Step]:
    """Train navigators over descents with attitude noise; their backbones were trained without this noise."""
    noise = {"dataset__nav__flight__attitude_sigma_deg": str(ATTITUDE_DEG)}
    needs = ("choose the headline ground",) if experiment.calibrate else ()
    rendered = _render(experiment, "attitude", "nav", headline_density(experiment) | noise, needs)
    return [rendered, *(_navigator(experiment, *words, "attitude") for words in navigators)]


def _navigator(experiment: Experiment, folder: str, detector: str, attention: str, reading: str) -> Step:
    """Train a navigator in one of three readings of the paper: pose, motion, or attitude (pose with attitude noise)."""
    name = folder if reading == "pose" else f"{folder}-{reading}"
    sizes = experiment.sizes
    detector = detector if sizes.navigator_width == 1.0 else f"{detector}-half-{sizes.seeds[0]}"
    width = 0.125 if experiment.preset == "tiny" else sizes.navigator_width
    backbone = experiment.runs / "detect" / detector / "checkpoints" / "best.ckpt"
    target, ground = (
        ("motion" if reading == "motion" else "pose"),
        ("attitude" if reading == "attitude" else "headline"),
    )
    settings = {"navigate__stack__attention": attention, "navigate__stack__target": target}
    settings |= {"navigate__detector": str(backbone), "navigate__stack__width": str(width)}
    if reading == "motion":
        settings |= {"navigate__stack__fine_epochs": "1", "navigate__stack__views": "0"}
    options = experiment.options("navigate", **settings)
    command = [
        *program("perilune-train"),
        "navigate",
        "train",
        *options,
        "--dataset",
        str(experiment.data / ground / "nav"),
    ]
    return Step(
        f"train {name}",
        [*command, "--out", str(experiment.runs), "--name", name],
        _finished(experiment.runs / "navigate" / f"{name}-stack"),
        (f"train {detector}", f"render {ground}, navigation"),
        width=width,
        attention=attention,
    )


def _transfer(experiment: Experiment) -> list[Step]:
    """Train detectors that start from YOLOv3 of COCO or from our detector of the usual ground.

    The initial weights are frozen in the first epochs.
    """
    width = 1.0 if experiment.darknet is not None else experiment.sizes.curve_width
    if experiment.darknet is None and (experiment.ground == Ground.LUNAR or not experiment.sizes.more):
        return []
    start = str(experiment.darknet or experiment.runs / "detect" / "lunar-yolov3" / "checkpoints" / "best.ckpt")
    more = {"detect__init_from": start, "detect__frozen_epochs": str(min(2, experiment.sizes.epochs - 1))}
    trainings = []
    for folder, attention in (("transfer-yolov3", "none"), ("transfer-attention-yolov3", "cbam")):
        step = _detector(experiment, "headline", folder, attention, width, **more)
        needs = step.needs if experiment.darknet is not None else (*step.needs, "train lunar-yolov3")
        trainings.append(replace(step, needs=needs))
    return trainings


def _benchmark_steps(experiment: Experiment) -> list[Step]:
    """Render a part of the locked benchmark, and score the detectors on it."""
    if experiment.preset != "paper" or not experiment.sizes.benchmark_scenes:
        return []
    command = ["scripts/render-benchmark", "detect", str(experiment.scored), str(experiment.sizes.benchmark_scenes)]
    parts = [experiment.scored / f"benchmark-detect-{part}" for part in ("highland", "mare", "camera")]
    benchmark_steps = [Step("render the benchmark", command, _rendered(*parts), renders=True)]
    for folder in ("yolov3", "attention-yolov3"):
        out = experiment.runs / "benchmark" / folder
        command = [*program("perilune-train"), "detect", "benchmark", "--run", str(experiment.runs / "detect" / folder)]
        command += ["--data", str(experiment.scored), "--out", str(out)]
        done = (out / "benchmark.json").is_file
        benchmark_steps.append(Step(f"benchmark {folder}", command, done, (f"train {folder}", "render the benchmark")))
    return benchmark_steps


def _page(experiment: Experiment) -> Step:
    sizes = experiment.sizes
    about = [f"preset `{experiment.preset}`, part `{experiment.part}`"]
    about += [f"attitude noise: {ATTITUDE_DEG:g} degree per axis, where named"] if experiment.attitude else []
    about += [
        f"{sizes.trajectories * sizes.frames} detection frames over each ground (the paper: 34,300), "
        f"{sizes.nav_trajectories} navigation trajectories of {sizes.frames} frames (the paper: 49 of 100); "
        f"{sizes.epochs} epochs of each detector on the headline ground and the curve, {sizes.long_epochs} on the "
        "sparse and on our usual ground"
    ]
    command = [*program("perilune-train"), "paper", "--runs", str(experiment.runs)]
    command += [
        "--dataset",
        str(experiment.data / "headline" / "detect"),
        "--headline-share",
        headline_share(experiment),
    ]
    return Step("page", [*command, *[text for line in about for text in ("--about", line)]], lambda: False)


def _rendered(*datasets: Path) -> Callable[[], bool]:
    return lambda: all(map(_complete, datasets))


def _complete(dataset: Path) -> bool:
    path = dataset / "dataset.json"
    return path.is_file() and json.loads(path.read_text(encoding="utf-8")).get("complete") is True


def _finished(run: Path) -> Callable[[], bool]:
    def whole() -> bool:
        # Check the file first: most runs do not exist yet, and importing torch takes seconds.
        if not (run / "metrics.json").is_file():
            return False
        from perilune_train.training.runs import RunFolder

        return RunFolder(run).finished

    return whole


def estimate(experiment: Experiment, plan: list[Step]) -> dict[str, float]:
    """Estimated seconds of the remaining long steps by title, from a few training steps on this machine."""
    from perilune_train.report.paper.probe import detect_seconds, navigate_seconds

    size_px = int(resolve(DatasetConfig, "dataset", "perilune_render", experiment.preset, PROTOCOL).camera.width_px)
    detect = resolve(DetectConfig, "detect", "perilune_train", experiment.preset, PROTOCOL, _sets(experiment, "detect"))
    navigate = resolve(
        NavigateConfig, "navigate", "perilune_train", experiment.preset, PROTOCOL, _sets(experiment, "navigate")
    )
    cores = len(os.sched_getaffinity(0))
    per_image: dict[tuple[float, str], float] = {}
    seconds_by_step: dict[str, float] = {}
    for step in plan:
        if step.done():
            continue
        if step.renders and step.images:
            seconds_by_step[step.title] = RENDER_CORE_S * step.images / cores
        elif step.images:
            kind = (step.width, step.attention)
            if kind not in per_image:
                config = detect.model_copy(update={"width": step.width, "attention": step.attention})
                per_image[kind] = detect_seconds(config, size_px)
            seconds_by_step[step.title] = per_image[kind] * step.images
        elif "lstm" in step.title:
            stack = navigate.stack.model_copy(update={"attention": step.attention, "width": step.width})
            seconds = navigate_seconds(navigate.model_copy(update={"stack": stack}))
            pairs = 0.8 * experiment.sizes.nav_trajectories * experiment.sizes.frames
            # The coarse stage only computes features, once, by a forward pass: a third of a training step.
            motion = step.title.endswith("motion")
            fine, views = (1, 0) if motion else (experiment.sizes.fine_epochs, navigate.stack.views)
            seconds_by_step[step.title] = seconds * pairs * (fine + (1 + views) / 3)
    return seconds_by_step


def _sets(experiment: Experiment, section: str) -> tuple[str, ...]:
    return tuple(f"{key}={value}" for key, value in experiment.settings(section).items())


def check_disk(experiment: Experiment, plan: list[Step]) -> None:
    """Raise UserError if the remaining frames do not fit on the disk."""
    folder = experiment.data
    while not folder.exists():
        folder = folder.parent
    needed = sum(FRAME_BYTES * step.images for step in plan if step.renders and not step.done())
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise UserError(
            experiment.data, "free disk", f"{free / 1e9:.1f} GB", f"at least {needed / 1e9:.1f} GB for the frames"
        )


def main(
    preset: Annotated[str, typer.Option(help="Preset of sizes: paper, or tiny for a trial.")] = "paper",
    part: Annotated[
        Part, typer.Option(help="whole (two cores, 20 core-hours), gpu (minutes), full (all frames of the paper).")
    ] = Part.WHOLE,
    ground: Annotated[
        Ground, typer.Option(help="Headline ground: as difficult as the paper's (pangu), or our usual one (lunar).")
    ] = Ground.PANGU,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Choose the headline ground's crater density again, by validation AP.")
    ] = False,
    attitude: Annotated[
        bool, typer.Option("--attitude", help="Also train navigators over descents with attitude noise.")
    ] = False,
    darknet: Annotated[Path | None, typer.Option(help="YOLOv3's weights of COCO (yolov3.weights).")] = None,
    benchmark: Annotated[Path, typer.Option(help="Folder of the rendered locked benchmark.")] = Path("data/benchmark"),
    minutes: Annotated[
        float | None, typer.Option(min=0.1, help="Stop after this time, and write the page from the finished steps.")
    ] = None,
) -> None:
    """Run all steps of the paper's experiment; run again to resume."""
    if preset not in ("paper", "tiny"):
        raise UserError("--preset", "", preset, "paper or tiny")
    if darknet is not None:
        check_start(darknet)
    if calibrate and ground == Ground.LUNAR:
        raise UserError("--calibrate", "--ground", ground, f"{Ground.PANGU}, whose density is chosen")
    experiment = Experiment(preset, part, ground, attitude, darknet, benchmark, calibrate)
    plan = steps(experiment)
    check_disk(experiment, plan)
    print(f"{experiment.runs}: {len(plan)} steps", flush=True)
    if minutes is None:
        expected = estimate(experiment, plan)
        for title, seconds in expected.items():
            print(f"  {title}: about {_hours(seconds)}")
        print(f"  long steps together: about {_hours(sum(expected.values()))}; Ctrl-C stops, run again to resume")
    else:
        expected = {}
    deadline = math.inf if minutes is None else time.monotonic() + 60 * minutes
    run_all(experiment, expected, deadline)
    print(f"{experiment.runs}: paper.md")


@dataclass
class Running:
    """A step whose command is running."""

    step: Step
    process: subprocess.Popen
    log: Path | None
    started: float


def run_all(experiment: Experiment, expected: dict[str, float], deadline: float) -> None:
    """Run the remaining steps: one after another, or simultaneously if the sizes allow several trainings.

    Raises typer.Exit with the exit code of the first step that fails, after the others have been stopped. At the
    deadline, running steps are stopped as by Ctrl-C, and the page is written.
    """
    running: list[Running] = []
    together = experiment.sizes.trainings > 1
    failed: dict[str, int] = {}
    began = time.monotonic()
    try:
        while True:
            plan = steps(experiment)
            titles = {step.title for step in plan if not step.done()}
            # A step that needs the result of a failed step never starts; the page is written last.
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
                    most = experiment.sizes.renderings if step.renders else experiment.sizes.trainings
                    if len(lane) < (most if together else 1):
                        running += _start(experiment, step, together, began, expected)
                        if callable(step.command) or not together:
                            break
            _wait(running, failed, together, deadline)
            if failed and not together:
                raise typer.Exit(next(iter(failed.values())))
    except KeyboardInterrupt:
        if together:
            _stop(running)
            raise
        # Ctrl-C has also reached the step, which has printed how to resume.
        _end(running)
        sys.stdout.flush()
        os._exit(EXIT_INTERRUPTED)
    for title, code in failed.items():
        print(f"failed with code {code}: {title}; see {_log(experiment, title)}", flush=True)
    _run(page)
    if failed:
        raise typer.Exit(next(iter(failed.values())))


def _start(
    experiment: Experiment, step: Step, together: bool, began: float, expected: dict[str, float]
) -> list[Running]:
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
    log = _log(experiment, step.title)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w", encoding="utf-8") as file:
        file.write(" ".join(_shown(word) for word in step.command) + "\n")
        file.flush()
        # A separate session, so that Ctrl-C reaches the step once, through this script.
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
    """Wait for steps that Ctrl-C has reached together with this script; stop those that do not end."""
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


def _log(experiment: Experiment, title: str) -> Path:
    return experiment.runs / "logs" / (re.sub(r"[^a-z0-9.-]+", "-", title.lower()) + ".log")


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
    # Wait longer at Ctrl-C than the commands that this program starts: they print how to resume.
    run_command_line(app, ended_after_s=2.5)
