"""Console on standard error and progress bar of the command lines, both from Rich."""

import time
from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

console = Console(stderr=True)
"""Console for messages; text that it prints appears above a running progress bar."""
_LOG_INTERVAL_S = 60.0
_LOG_WIDTH = 120
"""Characters of a line of progress in a file."""


class _Rate(ProgressColumn):
    """Column with the completed steps per second."""

    def render(self, task) -> Text:
        speed = task.finished_speed or task.speed
        unit = task.fields.get("unit", "steps")
        return Text("" if speed is None else f"{speed:.1f} {unit}/s")


class _Note(ProgressColumn):
    """Column with the task's current note, if it has one."""

    def render(self, task) -> Text:
        return Text(task.fields.get("note", ""))


class _LoggedProgress(Progress):
    """Progress that prints a line once a minute where the console is no terminal: Rich shows only the end there."""

    def __init__(self, *columns: ProgressColumn, clock: Callable[[], float], **fields: Any) -> None:
        super().__init__(*columns, get_time=clock, **fields)
        self._printed_s = clock()

    def advance(self, task_id: Any, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._log()

    def update(self, task_id: Any, **fields: Any) -> None:
        super().update(task_id, **fields)
        self._log()

    def _log(self) -> None:
        with self._lock:
            now_s = self.get_time()
            if self.console.is_terminal or self.finished or now_s - self._printed_s < _LOG_INTERVAL_S:
                return
            self._printed_s = now_s
            self.console.print(self.get_renderable(), width=_LOG_WIDTH)


def progress_bar(clock: Callable[[], float] = time.monotonic) -> Progress:
    """Create a progress bar on standard error: name, steps, rate, remaining time, and a note on the current step.

    In a file or pipe it is a line per task, at most once a minute and at the end. `clock` returns the time, s.
    """
    return _LoggedProgress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeRemainingColumn(),
        _Note(),
        clock=clock,
        console=console,
        refresh_per_second=2,
    )
