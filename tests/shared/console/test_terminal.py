"""Progress where the output is a file: a line now and then, with rate and time left."""

import io

import pytest
from rich.console import Console

from perilune_shared.console import terminal


@pytest.fixture
def log(monkeypatch):
    """What the progress bar writes to a file."""
    text = io.StringIO()
    monkeypatch.setattr(terminal, "console", Console(file=text, width=100, force_terminal=False))
    return text


def test_a_log_gets_a_line_at_most_once_a_minute(log):
    time_s = 0.0
    with terminal.progress_bar(clock=lambda: time_s) as progress:
        task = progress.add_task("detect frames", total=200, unit="frames")
        for _ in range(200):
            time_s += 1.0
            progress.advance(task)
            progress.update(task, note="scene-0003")
    lines = log.getvalue().splitlines()
    counts = [line.split("/200")[0].split()[-1] for line in lines]
    assert counts == ["60", "120", "180", "200"]
    assert "1.0 frames/s 0:02:20" in lines[0] and "scene-0003" in lines[1]


def test_a_short_task_leaves_one_line(log):
    with terminal.progress_bar() as progress:
        task = progress.add_task("merging", total=3, unit="scenes")
        for _ in range(3):
            progress.advance(task)
    assert len(log.getvalue().splitlines()) == 1


def test_a_task_takes_one_line_in_a_narrow_terminal(monkeypatch):
    text = io.StringIO()
    monkeypatch.setattr(terminal, "console", Console(file=text, width=72, force_terminal=True, color_system=None))
    with terminal.progress_bar() as progress:
        task = progress.add_task("classical methods", total=3, unit="trajectories")
        progress.update(task, note="a note on the current step that is longer than the line")
        progress.advance(task, 3)
    final = text.getvalue().split("\x1b[2K")[-1]
    assert final.count("\n") == 1 and "3/3" in final and final.endswith("\n\x1b[?25h")


def test_megabytes_have_a_decimal(log):
    with terminal.progress_bar() as progress:
        progress.advance(progress.add_task("hashing", total=0.42, unit="MB"), 0.42)
    assert "0.4/0.4" in log.getvalue()
