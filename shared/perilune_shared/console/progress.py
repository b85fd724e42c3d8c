"""Progress of long tasks, reported to any progress bar or to none.

Use: `task = progress.add_task("merging", total=n, unit="scenes")`, then `progress.advance(task)` after each step.
Command lines pass `terminal.progress_bar()`. Other callers pass nothing, and Rich is not imported.
"""

from typing import Any, Protocol


class Progress(Protocol):
    """The methods of a progress bar that long tasks call; rich.progress.Progress has them."""

    def add_task(self, description: str, *, total: float | None, **fields: Any) -> Any:
        """Start a task of `total` steps and return its id. `unit` is the plural name of a step."""

    def advance(self, task_id: Any, advance: float = 1) -> None:
        """Add completed steps to a task."""

    def update(self, task_id: Any, **fields: Any) -> None:
        """Set fields of a task: `completed`, or a `note` on the current step."""


class _NoProgress:
    """Ignores all reports."""

    def add_task(self, description: str, *, total: float | None, **fields: Any) -> None:
        pass

    def advance(self, task_id: Any, advance: float = 1) -> None:
        pass

    def update(self, task_id: Any, **fields: Any) -> None:
        pass


NO_PROGRESS: Progress = _NoProgress()
"""Default of functions that report progress."""


def say(line: str, style: str | None = None) -> None:
    """Print a line on standard error, above the progress bar if one is shown; `style` is a style of Rich."""
    # Rich is not imported before.
    from perilune_shared.console import terminal

    terminal.say(line, style)
