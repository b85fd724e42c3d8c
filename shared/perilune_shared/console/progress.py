"""Report the progress of long tasks to a progress bar, or discard it.

Use: `task = progress.add_task("merging", total=n, unit="scenes")`, then `progress.advance(task)` after each step.
Command lines pass `terminal.progress_bar()`. Other callers pass nothing, and Rich is not imported.
"""

from typing import Any, Protocol


class Progress(Protocol):
    """The methods of a progress bar that long tasks call; `rich.progress.Progress` has these methods."""

    def add_task(self, description: str, *, total: float | None, **fields: Any) -> Any:
        """Start a task of `total` steps and return its id. The field `unit` names the steps, in the plural."""

    def advance(self, task_id: Any, advance: float = 1) -> None:
        """Count further steps of a task as completed."""

    def update(self, task_id: Any, **fields: Any) -> None:
        """Set fields of a task, such as the number of steps `completed` or a `note` on the current step."""


class _NoProgress:
    """Progress that discards all reports."""

    def add_task(self, description: str, *, total: float | None, **fields: Any) -> None:
        pass

    def advance(self, task_id: Any, advance: float = 1) -> None:
        pass

    def update(self, task_id: Any, **fields: Any) -> None:
        pass


NO_PROGRESS: Progress = _NoProgress()
"""Default value of the parameter `progress`: reports are discarded."""


def say(line: str, style: str | None = None) -> None:
    """Print a line on standard error, above the progress bar if one is shown; `style` is a style of Rich."""
    # Imported here so that Rich is loaded only if something is printed.
    from perilune_shared.console import terminal

    terminal.say(line, style)
