"""Print lines, pages, tables and the progress bar of the command lines.

Most lines contain names from files, so these functions replace control characters and do not interpret markup.
`tests/test_house.py` fails if other modules print.
"""

import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table
from rich.text import Text

from perilune_shared.errors import one_line

# Not Jupyter: Rich would draw widgets, which need another package, and warn if that package is missing.
console = Console(stderr=True, force_jupyter=False)
"""Console for standard error and the progress bar; text printed on it appears above the bar."""
_LOG_INTERVAL_S = 60.0
_LOG_WIDTH = 120
"""Width of a progress line in a log file, characters."""


def say(line: object, style: str | None = None) -> None:
    """Print a line on standard error, above a running progress bar; `style` is a style of Rich."""
    console.print(Text(one_line(line), style=style or ""), soft_wrap=True)


def say_page(text: str) -> None:
    """Print several lines on standard error. Names from files must not contain line feeds."""
    console.print(Text(_lines(text)), soft_wrap=True)


def answer(line: object) -> None:
    """Print a line on standard output."""
    answer_page(one_line(line))


def answer_page(text: str) -> None:
    """Print several lines on standard output."""
    # Characters that the terminal's encoding lacks become question marks.
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    sys.stdout.write(_lines(text).rstrip("\n").encode(encoding, "replace").decode(encoding) + "\n")
    sys.stdout.flush()


def answer_table(
    head: Sequence[str],
    rows: Iterable[Sequence[object]],
    title: str = "",
    caption: str = "",
    *,
    numbers: bool = False,
) -> None:
    """Print a table on standard output; long cells are folded.

    `numbers` right-aligns all columns but the first.
    """
    table = Table(title=Text(one_line(title)) if title else None, caption=Text(one_line(caption)) if caption else None)
    for index, name in enumerate(head):
        table.add_column(Text(one_line(name)), justify="right" if numbers and index else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(one_line(cell), overflow="fold") for cell in row))
    Console().print(table)


def _lines(text: str) -> str:
    """Keep line ends and indents; replace other control characters by question marks."""
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


class _Steps(MofNCompleteColumn):
    """Column with completed and total steps, with one decimal if the total is not an integer (megabytes)."""

    def render(self, task) -> Text:
        if task.total is None or float(task.total).is_integer():
            return super().render(task)
        return Text(f"{task.completed:.1f}/{task.total:.1f}", style="progress.download")


class _Rate(ProgressColumn):
    """Column with the completed steps per second."""

    def render(self, task) -> Text:
        speed = task.finished_speed or task.speed
        unit = task.fields.get("unit", "steps")
        return Text("" if speed is None else f"{speed:.1f} {unit}/s")


class _Name(ProgressColumn):
    """Column with the task's description."""

    def render(self, task) -> Text:
        return Text(one_line(task.description))


class _Note(ProgressColumn):
    """Column with the task's current note, if it has one."""

    def render(self, task) -> Text:
        # The column itself has no `no_wrap`, so that Rich narrows it before the other columns.
        return Text(one_line(task.fields.get("note", "")), no_wrap=True, overflow="ellipsis")


class _LoggedProgress(Progress):
    """Progress that prints a line per minute if the console is not a terminal; Rich prints only the end."""

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


def _unwrapped() -> Column:
    # Keeps each task on one line, also in a narrow terminal.
    return Column(no_wrap=True, overflow="ellipsis")


def progress_bar(clock: Callable[[], float] = time.monotonic) -> Progress:
    """Create a progress bar on standard error: name, steps, rate, remaining time and a note.

    If standard error is a file or pipe, it prints one line per task instead, at most once a minute and at the end.
    `clock` returns the time in seconds.
    """
    return _LoggedProgress(
        _Name(table_column=_unwrapped()),
        BarColumn(),
        _Steps(table_column=_unwrapped()),
        _Rate(table_column=_unwrapped()),
        TimeRemainingColumn(),
        _Note(),
        clock=clock,
        console=console,
        refresh_per_second=2,
    )
