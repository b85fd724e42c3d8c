"""Run records: the commit is that of this repository, never of another one."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from perilune_shared import run_record as module

ASK = "from perilune_shared.run_record import run_record; print(run_record().commit)"


def git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), "-c", "user.name=a", "-c", "user.email=a@example.org", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def commit_by(path: Path) -> str:
    """Return the commit that the package in a folder records."""
    own = {**os.environ, "PYTHONPATH": str(path)}
    done = subprocess.run([sys.executable, "-c", ASK], env=own, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture
def checkout(tmp_path) -> Path:
    """A repository with shared/perilune_shared, like this one."""
    target = tmp_path / "checkout/shared/perilune_shared"
    shutil.copytree(Path(module.__file__).parent, target, ignore=shutil.ignore_patterns("__pycache__"))
    root = tmp_path / "checkout"
    git(root, "init", "-q")
    git(root, "add", ".")
    git(root, "commit", "-q", "-m", "one")
    return root


def test_the_commit_of_the_checkout_is_marked_if_files_are_modified(checkout):
    head = git(checkout, "rev-parse", "HEAD")
    (checkout / "untracked").touch()
    assert commit_by(checkout / "shared") == head
    (checkout / "shared/perilune_shared/__init__.py").write_text("changed = True\n")
    assert commit_by(checkout / "shared") == f"{head} modified"


def test_an_installed_package_ignores_the_repository_around_it(checkout):
    installed = checkout / "env/lib/site-packages"
    shutil.copytree(checkout / "shared/perilune_shared", installed / "perilune_shared")
    assert commit_by(installed) == "unknown"


def test_the_record_has_hardware_and_command():
    record = module.run_record()
    assert "cores" in record.hardware
    assert record.command
    assert len(record.date) == 10


def test_the_command_of_a_benchmark(tmp_path):
    bench = tmp_path / "bench"
    bench.mkdir()
    (bench / "speed.py").write_text("from perilune_shared.run_record import run_record; print(run_record().command)")
    done = subprocess.run(
        [sys.executable, "-m", "bench.speed", "--fast"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "python -m bench.speed --fast"


def test_the_command_of_a_console_script(tmp_path):
    (tmp_path / "measure.py").write_text(
        "from perilune_shared.run_record import run_record; print(run_record().command)"
    )
    for program in (["-m", "measure"], ["measure.py"]):
        command = [sys.executable, *program, "--set", "a=b c"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.stdout.strip() == f"python {' '.join(program)} --set 'a=b c'", done.stderr
