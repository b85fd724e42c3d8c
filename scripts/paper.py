"""The paper's experiment: render, train, evaluate, explain, and write its page. Run again to resume (`make paper`).

    python scripts/paper.py [--preset paper] [--part quarter|twentieth] [--attitude] [--darknet yolov3.weights]

Every step is one of the commands that a user has, printed before it runs. A finished step is left unchanged.
"""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from perilune_render.config import DatasetConfig
from perilune_shared.config import resolve
from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.navigate.config import NavigateConfig
from perilune_train.paper.parts import PARTS, Cut, Part
from perilune_train.paper.runs import DETECTORS, EXPLAINED, NAVIGATORS

BIN = Path(sys.executable).parent
PROTOCOL = Path("configs/paper_protocol.yaml")
ATTITUDE_DEG = 1.0
"""Standard deviation of the attitude in the second experiment, per axis."""
OWN = "train own network, to start from"
RENDER_FRAMES_PER_S = 4.0
"""Roughly, on two cores, scene included; the rendering states its own estimate when it runs."""


@dataclass(frozen=True)
class Step:
    """One command of the experiment."""

    title: str
    """What it does."""
    command: list[str]
    """Program and arguments."""
    done: Callable[[], bool]
    """Whether it is finished already."""
    seconds: float | None = None
    """Estimated time; None if it is short."""


@dataclass(frozen=True)
class Experiment:
    """Names, folders and settings of one experiment."""

    preset: str
    part: Part
    attitude: bool
    darknet: Path | None
    benchmark: Path

    @property
    def cut(self) -> Cut:
        """What is left out."""
        return PARTS[self.part]

    @property
    def label(self) -> str:
        """Name of the dataset and of the folders: paper, paper-tiny, paper-attitude."""
        preset = [] if self.preset == "paper" else [self.preset]
        return "-".join(["paper", *preset, *(["attitude"] if self.attitude else [])])

    @property
    def data(self) -> Path:
        """Folder of the rendered datasets."""
        return Path("data", self.label if self.part == Part.WHOLE else f"{self.label}-{self.part}")

    @property
    def runs(self) -> Path:
        """Folder of the runs and of the page."""
        return Path("runs", self.data.name)

    @property
    def scored(self) -> Path:
        """Folder of the rendered benchmark; a part of it has its own, named as `make benchmark SCENES=2` does."""
        scenes = self.cut.benchmark_scenes
        return self.benchmark.with_name(f"{self.benchmark.name}-{scenes}-scenes") if scenes else self.benchmark

    @property
    def settings(self) -> dict[str, str]:
        """Settings over the preset and the protocol."""
        chosen = self.cut.settings | {"dataset.name": self.label}
        if self.preset == "tiny":
            # Frozen and unfrozen epochs, coarse and fine ones, as in the whole experiment.
            chosen |= {"detect.epochs": "2", "detect.frozen_epochs": "1"}
        elif self.part == Part.WHOLE:
            chosen |= {"detect.frozen_epochs": "5"}
        if self.attitude:
            for kind in ("detect", "nav"):
                chosen[f"dataset.{kind}.flight.attitude_sigma_deg"] = str(ATTITUDE_DEG)
        return chosen

    def options(self, *sections: str, **more: str) -> list[str]:
        """Options of a command that reads these sections; `more` are settings of the detector or navigator."""
        pairs = self.settings | {key.replace("__", "."): value for key, value in more.items()}
        own = {key: value for key, value in pairs.items() if key.split(".")[0] in sections}
        sets = [text for key, value in own.items() for text in ("--set", f"{key}={value}")]
        return ["--preset", self.preset, "--config", str(PROTOCOL), *sets]


def steps(one: Experiment) -> list[Step]:
    """All steps in order."""
    return [*_data_steps(one), *_network_steps(one), *_benchmark_steps(one), *_page_steps(one)]


def _data_steps(one: Experiment) -> list[Step]:
    render, manifest = str(BIN / "perilune-render"), str(BIN / "perilune-manifest")
    found = []
    for kind in ("detect", "nav"):
        out = one.data / kind
        plan = one.data / "plans" / kind
        options = one.options("dataset")
        found.append(
            Step(
                f"plan {kind}",
                [render, "plan", "--kind", kind, *options, "--out", str(plan)],
                _rendered(plan),
            )
        )
        source, where = plan, _chosen(kind, one.cut)
        if where is not None:
            source = one.data / "plans" / f"{kind}-{one.part}"
            command = [manifest, "subset", str(plan), "--out", str(source), "--images", "none", "--where", where]
            found.append(Step(f"take {where}", command, _rendered(source)))
        command = [render, "dataset", "--manifest", str(source), "--out", str(out)]
        found.append(Step(f"render {kind}", command, _rendered(out)))
    return found


def _chosen(kind: str, cut: Cut) -> str | None:
    """Condition on the frames of a plan that a part takes; None for all frames."""
    if kind == "detect":
        return f"frame_index % {cut.detect_every} == 0" if cut.detect_every > 1 else None
    return None if cut.nav_trajectories is None else f"trajectory_id < 'trajectory-{cut.nav_trajectories:04d}'"


def _network_steps(one: Experiment) -> list[Step]:
    train = str(BIN / "perilune-train")
    found = []
    if one.darknet is None:
        found += _own_network(one)
    start = str(one.darknet or one.runs / "detect" / "own" / "checkpoints" / "best.ckpt")
    for folder, attention in zip(DETECTORS.values(), ("none", "cbam"), strict=True):
        options = one.options("detect", detect__attention=attention, detect__init_from=start)
        command = [train, "detect", "train", *options, "--dataset", str(one.data / "detect"), "--out", str(one.runs)]
        run = one.runs / "detect" / folder
        found.append(Step(f"train {folder}", [*command, "--name", folder], _finished(run)))
    for folder, detector, attention in zip(NAVIGATORS.values(), DETECTORS.values(), ("none", "cbam"), strict=True):
        backbone = one.runs / "detect" / detector / "checkpoints" / "best.ckpt"
        options = one.options("navigate", navigate__stack__attention=attention, navigate__detector=str(backbone))
        command = [train, "navigate", "train", *options, "--dataset", str(one.data / "nav"), "--out", str(one.runs)]
        run = one.runs / "navigate" / f"{folder}-stack"
        found.append(Step(f"train {folder}", [*command, "--name", folder], _finished(run)))
    attended = one.runs / "detect" / DETECTORS["attention-YOLOv3"] / "checkpoints" / "best.ckpt"
    navigator = one.runs / "navigate" / f"{NAVIGATORS['attention-Darknet53-LSTM']}-stack" / "checkpoints" / "best.ckpt"
    command = [train, "explain", "--preset", one.preset, "--dataset", str(one.data), "--out", str(one.runs)]
    command += ["--name", EXPLAINED, "--detector", str(attended), "--navigator", str(navigator)]
    return [*found, Step("explain", command, _finished(one.runs / "explain" / EXPLAINED))]


def _own_network(one: Experiment) -> list[Step]:
    """The network that stands in for YOLOv3 trained on COCO: the same without attention, on terrain of its own."""
    pretraining = "tiny" if one.preset == "tiny" else "small"
    data, run = Path("data", pretraining, "detect"), one.runs / "detect" / "own"
    settings = {"attention": "none", "in_channels": "3", "strides": "[8, 16, 32]"}
    settings |= {} if one.preset == "tiny" else {"width": "1.0", "epochs": str(one.cut.own_epochs)}
    sets = [text for key, value in settings.items() for text in ("--set", f"detect.{key}={value}")]
    render = [str(BIN / "perilune-render"), "dataset", "--preset", pretraining, "--kind", "detect"]
    train = [str(BIN / "perilune-train"), "detect", "train", "--preset", pretraining, *sets, "--dataset", str(data)]
    return [
        Step(f"render {pretraining}, to pretrain on", [*render, "--out", str(data.parent)], _rendered(data)),
        Step(OWN, [*train, "--out", str(one.runs), "--name", "own"], _finished(run)),
    ]


def _benchmark_steps(one: Experiment) -> list[Step]:
    """Scores on the locked benchmark; with a preset for trials only if it is rendered already."""
    found = []
    train = str(BIN / "perilune-train")
    for kind, networks in (("detect", DETECTORS), ("nav", NAVIGATORS)):
        rendered = any(one.scored.glob(f"benchmark-{kind}-*/dataset.json"))
        if one.preset == "paper":
            command = ["scripts/render-benchmark", kind, str(one.scored), str(one.cut.benchmark_scenes)]
            parts = [one.scored / f"benchmark-{kind}-{part}" for part in ("highland", "mare", "camera")]
            found.append(Step(f"render the benchmark, {kind}", command, _rendered(*parts)))
        elif not rendered:
            continue
        if kind == "nav" and _navigate_settings(one).stack.target == "pose":
            # A pose is known over the landing area of the training only.
            continue
        for folder in networks.values():
            task, run = ("detect", f"detect/{folder}") if kind == "detect" else ("navigate", f"navigate/{folder}-stack")
            out = one.runs / "benchmark" / folder
            command = [train, task, "benchmark", "--run", str(one.runs / run), "--data", str(one.scored)]
            found.append(
                Step(
                    f"benchmark {folder}",
                    [*command, "--out", str(out)],
                    _written(out / "benchmark.json"),
                )
            )
    return found


def _page_steps(one: Experiment) -> list[Step]:
    about = [
        f"preset `{one.preset}`, part `{one.part}`, attitude noise of {ATTITUDE_DEG if one.attitude else 0:g} degrees"
    ]
    about += one.cut.lines
    command = [str(BIN / "perilune-train"), "paper", "--runs", str(one.runs), "--dataset", str(one.data / "detect")]
    return [Step("page", [*command, *[text for line in about for text in ("--about", line)]], lambda: False)]


def _rendered(*datasets: Path) -> Callable[[], bool]:
    return lambda: all(map(_complete, datasets))


def _complete(dataset: Path) -> bool:
    path = dataset / "dataset.json"
    return path.is_file() and json.loads(path.read_text(encoding="utf-8")).get("complete") is True


def _written(file: Path) -> Callable[[], bool]:
    return file.is_file


def _finished(run: Path) -> Callable[[], bool]:
    return _written(run / "metrics.json")


def estimate(one: Experiment, plan: list[Step]) -> dict[str, float]:
    """Seconds of the long steps that are left, from a few training steps on this machine, by title."""
    from perilune_train.paper.probe import detect_seconds, navigate_seconds

    dataset = _dataset_settings(one)
    sets = tuple(f"{key}={value}" for key, value in one.settings.items())
    detect = resolve(DetectConfig, "detect", "perilune_train", one.preset, PROTOCOL, _of("detect", sets))
    navigate = _navigate_settings(one)
    left = {step.title for step in plan if not step.done()}
    size = int(dataset["width_px"])
    found: dict[str, float] = {}
    for kind in ("detect", "nav"):
        if f"render {kind}" in left:
            found[f"render {kind}"] = dataset[kind] / RENDER_FRAMES_PER_S
    if OWN in left:
        # `small` has 1088 training frames, `tiny` fewer.
        found[OWN] = detect_seconds(detect.model_copy(update={"attention": "none"}), size) * 1088 * one.cut.own_epochs
    for folder, attention in zip(DETECTORS.values(), ("none", "cbam"), strict=True):
        if f"train {folder}" in left:
            seconds = detect_seconds(detect.model_copy(update={"attention": attention}), size)
            # Validation takes a tenth of the frames and a third of the time of a training frame.
            found[f"train {folder}"] = seconds * dataset["detect"] * detect.epochs * (0.8 + 0.1 / 3)
    for folder, attention in zip(NAVIGATORS.values(), ("none", "cbam"), strict=True):
        if f"train {folder}" in left:
            own = navigate.stack.model_copy(update={"attention": attention})
            seconds = navigate_seconds(navigate.model_copy(update={"stack": own}))
            found[f"train {folder}"] = seconds * dataset["nav"] * (own.fine_epochs * (0.8 + 0.1 / 3) + 0.9 / 3)
    return found


def _navigate_settings(one: Experiment) -> NavigateConfig:
    sets = tuple(f"{key}={value}" for key, value in one.settings.items())
    return resolve(NavigateConfig, "navigate", "perilune_train", one.preset, PROTOCOL, _of("navigate", sets))


def _of(section: str, settings: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(text for text in settings if text.startswith(f"{section}."))


def _dataset_settings(one: Experiment) -> dict[str, float]:
    """Numbers of frames of both datasets, and the width of a frame."""
    sets = tuple(f"{key}={value}" for key, value in one.settings.items())
    dataset = resolve(DatasetConfig, "dataset", "perilune_render", one.preset, PROTOCOL, _of("dataset", sets))
    frames = {}
    for kind in ("detect", "nav"):
        own = dataset.kind(kind)
        frames[kind] = float(own.n_scenes * own.trajectories_per_scene * own.n_frames)
    frames["detect"] /= one.cut.detect_every
    if one.cut.nav_trajectories is not None:
        frames["nav"] = min(frames["nav"], float(one.cut.nav_trajectories * dataset.nav.n_frames))
    return {**frames, "width_px": dataset.camera.width_px}


def main(
    preset: Annotated[str, typer.Option(help="Preset of sizes: paper, or tiny for a trial.")] = "paper",
    part: Annotated[Part, typer.Option(help="whole, or quarter or twentieth: for two cores.")] = Part.WHOLE,
    attitude: Annotated[bool, typer.Option("--attitude", help="The second experiment, with attitude noise.")] = False,
    darknet: Annotated[Path | None, typer.Option(help="YOLOv3's weights of COCO (yolov3.weights).")] = None,
    benchmark: Annotated[Path, typer.Option(help="Folder of the rendered locked benchmark.")] = Path("data/benchmark"),
) -> None:
    """Run all steps."""
    if preset not in ("paper", "small", "tiny"):
        raise UserError("--preset", "preset", preset, "paper, small or tiny")
    if darknet is not None and not darknet.is_file():
        raise UserError(darknet, "--darknet", "no such file", "yolov3.weights")
    one = Experiment(preset, part, attitude, darknet, benchmark)
    plan = steps(one)
    print(f"{one.runs}: {len(plan)} steps; measuring the speed of this machine", flush=True)
    expected = estimate(one, plan)
    for title, seconds in expected.items():
        print(f"  {title}: about {_hours(seconds)}")
    print(f"  long steps together: about {_hours(sum(expected.values()))}; stop with Ctrl-C, run again to resume")
    started = time.monotonic()
    for number, step in enumerate(plan, 1):
        if step.done():
            print(f"step {number} of {len(plan)}: {step.title}: finished", flush=True)
            continue
        print(f"step {number} of {len(plan)}: {step.title}, after {_hours(time.monotonic() - started)}", flush=True)
        print("  " + " ".join(_shown(word) for word in step.command), flush=True)
        done = subprocess.run(step.command, check=False)
        if done.returncode:
            raise typer.Exit(done.returncode)
    print(f"{one.runs}: paper.md")


def _shown(word: str) -> str:
    word = word.removeprefix(f"{BIN}/")
    return f"'{word}'" if re.search(r"[\s\[\]{}]", word) else word


def _hours(seconds: float) -> str:
    return f"{seconds / 3600:.1f} hours" if seconds >= 3600 else f"{seconds / 60:.0f} minutes"


if __name__ == "__main__":
    from perilune_shared.command_line import run_command_line

    app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
    app.command()(main)
    run_command_line(app)
