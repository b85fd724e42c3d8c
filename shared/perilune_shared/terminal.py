"""Console on standard error and progress bar of the command lines, both from Rich."""

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


def progress_bar() -> Progress:
    """Create a progress bar on standard error: name, steps, rate, remaining time, and a note on the current step."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeRemainingColumn(),
        _Note(),
        console=console,
        refresh_per_second=2,
    )
