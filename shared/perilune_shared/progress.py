"""One look of progress bar for every long work: what, how far, rate, time left."""

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


class _Rate(ProgressColumn):
    """Finished steps per second."""

    def render(self, task) -> Text:
        speed = task.finished_speed or task.speed
        unit = task.fields.get("unit", "steps")
        return Text("" if speed is None else f"{speed:.1f} {unit}/s")


class _Note(ProgressColumn):
    """What the task is at, where it says so."""

    def render(self, task) -> Text:
        return Text(task.fields.get("note", ""))


def progress_bar() -> Progress:
    """A progress bar on standard error; give each task `unit="frames"` for its rate."""
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
