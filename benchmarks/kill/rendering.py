"""The rendering that is killed: 16 frames of 64 x 64 px over two scenes, by the command `perilune-render dataset`."""

import contextlib
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from perilune_render.jobs.status import status_of
from perilune_shared.errors import UserError
from perilune_shared.storage.store import open_store

SETTINGS = (
    "dataset.camera.width_px=64",
    "dataset.camera.height_px=64",
    "dataset.terrain.spacing_px=1.0",
    "dataset.render.threads=1",
    "dataset.detect.n_scenes=2",
    "dataset.detect.trajectories_per_scene=2",
    "dataset.detect.n_frames=4",
)
COMMAND = (
    str(Path(sys.executable).parent / "perilune-render"),
    *("dataset", "--preset", "tiny", "--kind", "detect"),
    *(part for setting in SETTINGS for part in ("--set", setting)),
)
_PHASES = ("start", "begun", "frames", "rendered", "complete")
_POLL_S = 0.01
_LONGEST_S = 300.0


class Rendering:
    """One run of the command into an address; `options` are further options of the command."""

    def __init__(self, out: str, *options: str, environment: Mapping[str, str] | None = None):
        self.out = out
        self.begin_s = time.monotonic()
        self._stderr = tempfile.TemporaryFile("w+")  # noqa: SIM115 - a pipe would stay open in orphaned processes
        self.process = psutil.Popen(
            [*COMMAND, "--out", out, *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._stderr,
            # A wide terminal: the progress bar is one line.
            env={**os.environ, "COLUMNS": "200", **(environment or {})},
        )

    @property
    def age_s(self) -> float:
        """Time since its start, seconds."""
        return time.monotonic() - self.begin_s

    @property
    def runs(self) -> bool:
        """Whether it still runs."""
        return self.process.poll() is None

    def send(self, number: int) -> bool:
        """Send a signal; returns whether it still ran."""
        try:
            self.process.send_signal(number)
        except psutil.NoSuchProcess:
            return False
        return True

    def below(self) -> list[psutil.Process]:
        """All processes that it has started and that still run."""
        try:
            return self.process.children(recursive=True)
        except psutil.NoSuchProcess:
            return []

    def workers(self) -> list[psutil.Process]:
        """Its worker processes."""
        found = []
        for process in self.below():
            with contextlib.suppress(psutil.Error):
                if "perilune_render.jobs.worker" in process.cmdline():
                    found.append(process)
        return found

    def wait(self) -> int:
        """Wait until it ends; returns its exit code."""
        return self.process.wait(_LONGEST_S)

    @property
    def stderr(self) -> str:
        """What it has written to standard error."""
        self._stderr.seek(0)
        return self._stderr.read()


def phase(out: str) -> str:
    """How far the dataset `detect` at an address is: start, begun, frames, rendered (all trajectories) or complete."""
    store = open_store(out).sub("detect")
    try:
        if not store.exists("dataset.json"):
            return "start"
        status = status_of(store)
    except UserError:
        return "begun"  # dataset.json is written, the record of the plan is not
    if status.complete:
        return "complete"
    if status.n_done == status.n_trajectories:
        return "rendered"
    return "frames" if next(store.list("frames"), None) is not None else "begun"


def files_of(out: str) -> dict[str, bytes]:
    """The content of each file below an address, by path."""
    store = open_store(out)
    return {item.path: store.read(item.path) for item in store.list()}


@dataclass(frozen=True, slots=True)
class Moment:
    """A moment of a run: some time after it reaches a phase."""

    phase: str
    """The phase."""
    later_s: float
    """Time after the run is first seen in it, seconds."""

    def wait(self, run: Rendering) -> None:
        """Wait for the moment in a run, or for the end of the run."""
        while run.runs and _PHASES.index(phase(run.out)) < _PHASES.index(self.phase):
            time.sleep(_POLL_S)
        end_s = time.monotonic() + self.later_s
        while run.runs and time.monotonic() < end_s:
            time.sleep(_POLL_S)


@dataclass(frozen=True, slots=True)
class Undisturbed:
    """A run that nothing disturbs."""

    files: dict[str, bytes]
    """The content of each file, by path."""
    seconds: dict[str, float]
    """How long it stayed in each phase, seconds."""

    @classmethod
    def of(cls, out: str, *options: str) -> "Undisturbed":
        """Render into an address."""
        run = Rendering(out, *options)
        seconds = dict.fromkeys(_PHASES, 0.0)
        last_s = time.monotonic()
        while run.runs:
            time.sleep(_POLL_S)
            now_s = time.monotonic()
            seconds[phase(out)] += now_s - last_s
            last_s = now_s
        if run.wait():
            raise RuntimeError(f"the undisturbed run failed: {run.stderr}")
        return cls(files_of(out), seconds)

    def moment(self, draw: random.Random, *, resumed: bool) -> Moment:
        """A random moment: one in ten in the start, three in ten after the last trajectory, the others in between."""
        after = draw.choices(("start", "begun", "rendered"), (1, 6, 3))[0]
        work_s = self.seconds["begun"] + self.seconds["frames"]
        if after == "begun" and resumed:
            # The phase is reached already; most of the start are imports.
            return Moment("start", draw.uniform(0.7 * self.seconds["start"], self.seconds["start"] + work_s))
        return Moment(after, draw.uniform(0.0, work_s if after == "begun" else self.seconds[after]))


Record = dict[str, Any]
"""One trial: its `moments` (`moment_s` since the start of the run, `phase`, `disturbed`), `attempts`, `identical`."""


def finished(
    out: str,
    whole: Undisturbed,
    attempts: int,
    *options: str,
    environment: Mapping[str, str] | None = None,
) -> Record:
    """Resume by the same command; returns the number of `attempts` and whether the dataset is `identical`."""
    run = Rendering(out, *options, environment=environment)
    code, attempts = run.wait(), attempts + 1
    found: Record = {"attempts": attempts, "identical": code == 0 and files_of(out) == whole.files}
    if not found["identical"]:
        found["fault"] = run.stderr[-1000:] if code else first_difference(files_of(out), whole.files)
    return found


def first_difference(found: dict[str, bytes], expected: dict[str, bytes]) -> str:
    """The first path at which two datasets differ, and how."""
    for path in sorted({*found, *expected}):
        if found.get(path) != expected.get(path):
            state = "missing" if path not in found else "unexpected" if path not in expected else "other content"
            return f"{path}: {state}"
    return ""
