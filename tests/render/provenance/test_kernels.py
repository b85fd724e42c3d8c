"""Kernels are compiled again when any source that is compiled into them changes."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import perilune_render
import perilune_shared

CALLEE = (
    "from perilune_render.provenance.kernels import njit\nSTEP = {step}\n@njit()\ndef add(x):\n    return x + STEP\n"
)
CALLER = """
from perilune_render.callee import STEP, add
from perilune_render.provenance.kernels import njit
@njit()
def both(x):
    return add(x) * 100 + STEP
if __name__ == "__main__":
    print(both(1), sum(both.stats.cache_hits.values()))
"""


def start(root):
    """A process that prints what the caller computes, and how often it took kept machine code."""
    paths = os.pathsep.join([str(root), str(Path(perilune_shared.__path__[0]).parent)])
    environment = {**os.environ, "PYTHONPATH": paths, "XDG_CACHE_HOME": str(root / "cache")}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-m", "perilune_render.caller"]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def run(root, n_processes=1):
    """What each of several processes prints that run at the same time."""
    processes = [start(root) for _ in range(n_processes)]
    printed = [process.communicate()[0] for process in processes]
    assert not any(process.returncode for process in processes)
    return [[int(word) for word in each.split()] for each in printed]


@pytest.fixture
def package(tmp_path):
    """A package with a compiled function that calls one of another file."""
    package = tmp_path / "perilune_render"
    source = Path(perilune_render.__path__[0])
    shutil.copytree(source / "provenance", package / "provenance", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(source / "__init__.py", package)
    (package / "caller.py").write_text(CALLER)
    (package / "callee.py").write_text(CALLEE.format(step=2))
    return package


def test_a_change_in_another_file_is_compiled_into_its_callers(package, tmp_path):
    assert run(tmp_path) == [[302, 0]]
    (package / "callee.py").write_text(CALLEE.format(step=30))
    assert run(tmp_path) == [[3130, 0]]
    assert run(tmp_path) == [[3130, 1]]


def test_of_two_processes_one_compiles_a_kernel_and_the_other_waits(package, tmp_path):
    assert sorted(run(tmp_path, 2)) == [[302, 0], [302, 1]]


def test_a_damaged_file_of_hashes_is_replaced(package, tmp_path):
    run(tmp_path)
    (kept,) = tmp_path.rglob("hashes-*.json")
    content = kept.read_text()
    for damaged in ("", "{", "[]", content.replace('"fingerprints": {"', '"fingerprints": {"other ')):
        kept.write_text(damaged)
        assert run(tmp_path) == [[302, 1]]
    assert json.loads(kept.read_text())["state"] == json.loads(content)["state"]
