"""Datasets that a command of `perilune-render` renders once for all processes of a test run."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock

from tests.helpers import in_process

QUICK = tuple(
    f"--set=dataset.{setting}" for setting in ("render.engine=heightfield", "render.samples=1", "terrain.spacing_px=2")
)
"""Options of a dataset that renders quickly: without Blender, on ground with a sixteenth of the vertices."""


def in_a_process(*arguments: str) -> subprocess.CompletedProcess:
    """Run `perilune-render` as a user does."""
    program = str(Path(sys.executable).parent / "perilune-render")
    return subprocess.run([program, *arguments], capture_output=True, text=True)


def in_this_process(*arguments: str) -> subprocess.CompletedProcess:
    """Run `perilune-render` in the process of the test."""
    from perilune_render.cli.main import main

    return in_process.call(main, *arguments)


def rendered_once(folder: Path, run: Callable[..., subprocess.CompletedProcess], *arguments: str) -> Path:
    """Render into `folder` unless another process has done so; the test is skipped without the renderer."""
    pytest.importorskip("perilune_render", reason="needs a rendered dataset")
    with FileLock(f"{folder}.lock"):
        if not Path(f"{folder}.made").exists():
            # No worker processes, so that libraries are loaded once.
            done = run(*arguments, "--out", str(folder), "--workers", "0")
            assert done.returncode == 0, done.stderr
            Path(f"{folder}.made").touch()
    return folder
