"""All steps of `make demo`: frames, detection, navigation, explanation, report.

Navigation frames are rendered while the detector is trained; their progress is in <data>/nav.log. Ctrl-C stops all
commands and keeps finished work. Run the same command again to resume.

    python scripts/demo.py --preset demo --name demo --data data/demo --runs runs --set dataset.seed=7
"""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import typer

from perilune_render.config.dataset import DatasetConfig
from perilune_shared.config.resolve import Section, resolve
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.errors import EXIT_INTERRUPTED, UserError
from perilune_shared.run_record import run_record
from perilune_shared.storage.files import write_text
from perilune_shared.threads import usable_cores
from perilune_train.detect.config import DetectConfig
from perilune_train.explain.config import ExplainConfig
from perilune_train.motion.config import NavigateConfig
from perilune_train.records.metrics_file import has_metrics

BIN = Path(sys.executable).parent
SECTIONS: dict[str, tuple[type[Section], str]] = {
    "dataset": (DatasetConfig, "perilune_render"),
    "detect": (DetectConfig, "perilune_train"),
    "navigate": (NavigateConfig, "perilune_train"),
    "explain": (ExplainConfig, "perilune_train"),
}
"""Sections of a configuration, with the packages of their presets."""
FIRST_STEP = "render detection frames"
DRAWS = 10
"""Number of simulated flights of the filter over each test descent."""


@dataclass(frozen=True, slots=True)
class Demo:
    """Folders and settings of one demo."""

    name: str
    """Name of the runs."""
    data: Path
    """Folder of the datasets."""
    runs: Path
    """Folder of the runs."""
    settings: tuple[str, ...]
    """Options of all commands: preset, configuration file, single settings."""
    render_options: tuple[str, ...] = ()
    """Further options of the commands that render: elevation model and catalogue."""

    def render(self, kind: str, *options: str) -> list[str]:
        """Command that renders a dataset."""
        options = ("--kind", kind, "--out", str(self.data), *self.render_options, *options)
        return ["perilune-render", "dataset", *self.settings, *options]

    def train(self, *words: str, dataset: Path) -> list[str]:
        """Command that trains on a dataset, or explains."""
        folders = ["--out", str(self.runs), "--name", self.name, "--dataset", str(dataset)]
        return ["perilune-train", *words, *self.settings, *folders]

    def rendered(self, kind: str) -> bool:
        """Whether a dataset is complete. An interrupted rendering also has a dataset.json."""
        path = self.data / kind / "dataset.json"
        return path.is_file() and json.loads(path.read_text(encoding="utf-8")).get("complete") is True


class Processes:
    """Commands of the demo. Each is in a separate process group, so that only this class interrupts it after Ctrl-C."""

    def __init__(self) -> None:
        self._running: list[subprocess.Popen] = []
        self._begun_s = time.monotonic()
        self.started_s: dict[str, float] = {}
        """Start of each step, seconds since the start of the demo."""

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start of the demo."""
        return time.monotonic() - self._begun_s

    def run(self, title: str, command: list[str]) -> None:
        """Run a command to its end, and end this program with its exit code if it fails."""
        self.end(self.start(title, command))

    def start(self, title: str, command: list[str], log: Path | None = None) -> subprocess.Popen:
        """Start a command; its output goes to the file `log`, if given."""
        self.started_s[title] = round(self.elapsed_s, 1)
        print(f"{title}, after {self.elapsed_s / 60:.1f} minutes" + (f"; progress in {log}" if log else ""), flush=True)
        program = [str(BIN / command[0]), *command[1:]]
        if log is None:
            process = subprocess.Popen(program, process_group=0)
        else:
            log.parent.mkdir(parents=True, exist_ok=True)
            with log.open("w", encoding="utf-8") as file:
                process = subprocess.Popen(program, process_group=0, stdout=file, stderr=subprocess.STDOUT)
        self._running.append(process)
        return process

    def end(self, process: subprocess.Popen, log: Path | None = None) -> None:
        """Wait for a command. If it fails, stop the others and end this program with its exit code."""
        code = process.wait()
        self._running.remove(process)
        if code:
            if log is not None:
                print("\n".join(log.read_text(encoding="utf-8").splitlines()[-3:]), file=sys.stderr)
            self.stop()
            raise SystemExit(code)

    def stop(self) -> None:
        """Interrupt all commands and wait for them."""
        for process in self._running:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in self._running:
            process.wait()


def run_steps(demo: Demo, processes: Processes) -> None:
    """Run the steps that are not finished."""
    if not demo.rendered("detect"):
        processes.run(FIRST_STEP, demo.render("detect"))
    log = demo.data / "nav.log"
    beside = None
    if not demo.rendered("nav"):
        # Half of the cores render, and the other half trains.
        options = ("--workers", str(max(1, usable_cores() // 2)))
        beside = processes.start("render navigation frames in the background", demo.render("nav", *options), log)
    processes.run("train the detector", demo.train("detect", "train", dataset=demo.data / "detect"))
    installed = demo.runs / "detect" / f"{demo.name}-installed"
    if not has_metrics(installed):
        folders = ["--dataset", str(demo.data / "detect"), "--out", str(installed)]
        processes.run("evaluate the installed detector", ["perilune-train", "detect", "evaluate", *folders])
    if beside is not None:
        processes.end(beside, log)
    processes.run("train the navigators", demo.train("navigate", "train", dataset=demo.data / "nav"))
    landing = demo.runs / "navigate" / f"{demo.name}-landing"
    page = landing / "monte_carlo.md"
    if not (page.is_file() and page.stat().st_size > 0):
        folders = ["--draws", str(DRAWS), "--dataset", str(demo.data / "nav"), "--out", str(landing)]
        processes.run("land with the filter", ["perilune-train", "navigate", "monte-carlo", *folders])
    processes.run("explain", demo.train("explain", dataset=demo.data))
    report = demo.runs / "report" / demo.name
    folders = ["--name", demo.name, "--dataset", str(demo.data), "--runs", str(demo.runs), "--out", str(report)]
    processes.run("report", ["perilune-train", "report", *folders])
    if FIRST_STEP in processes.started_s:
        # A resumed demo has timed only some of the steps.
        figures = {"seconds": round(processes.elapsed_s, 1), "started_s": processes.started_s}
        write_text(report / "demo.json", json.dumps({**figures, "run": asdict(run_record())}, indent=2) + "\n")
    print(f"after {processes.elapsed_s / 60:.1f} minutes", flush=True)


def main(
    preset: str = "demo",
    config: Annotated[Path | None, typer.Option(help="YAML file of settings, as for all commands.")] = None,
    settings: Annotated[list[str] | None, typer.Option("--set", help="One setting, as for all commands.")] = None,
    name: str = "demo",
    data: Path = Path("data/demo"),
    runs: Path = Path("runs"),
    dem: Annotated[str | None, typer.Option(help="Elevation model of the ground.")] = None,
    catalogue: Annotated[str | None, typer.Option(help="Craters of the elevation model.")] = None,
) -> None:
    """Run all steps of the demo."""
    run_record()
    for folder in (data, runs):
        if folder.exists() and not folder.is_dir():
            raise UserError(folder, "folder", "a file", "a folder, or nothing")
    changes = tuple(settings or ())
    # Check the settings of all steps before the first step runs.
    for section, (model, package) in SECTIONS.items():
        resolve(model, section, package, preset, config, changes)
    elevation_options = {"--dem": dem, "--catalogue": catalogue}
    render_options = tuple(
        word for name, value in elevation_options.items() if value is not None for word in (name, value)
    )
    common = ["--preset", preset, *(["--config", str(config)] if config else [])]
    common += [word for change in changes for word in ("--set", change)]
    demo = Demo(name, data, runs, tuple(common), render_options)
    processes = Processes()
    try:
        run_steps(demo, processes)
    except KeyboardInterrupt:
        processes.stop()
        # The command in the foreground has printed how to resume; `run_command_line` would print it again.
        sys.stdout.flush()
        os._exit(EXIT_INTERRUPTED)


if __name__ == "__main__":
    # Wait longer at Ctrl-C than the commands that this program starts: they print how to resume.
    run_command_line(one_command(main), ended_after_s=2.5)
