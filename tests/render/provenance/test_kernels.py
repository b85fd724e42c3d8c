"""Kernels are compiled again when any source that is compiled into them changes."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

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


def run(root):
    """What the caller computes, and how often it took kept machine code."""
    paths = os.pathsep.join([str(root), str(Path(perilune_shared.__path__[0]).parent)])
    environment = {**os.environ, "PYTHONPATH": paths, "XDG_CACHE_HOME": str(root / "cache")}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-m", "perilune_render.caller"]
    printed = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
    return [int(word) for word in printed.split()]


def test_a_change_in_another_file_is_compiled_into_its_callers(tmp_path):
    package = tmp_path / "perilune_render"
    source = Path(perilune_render.__path__[0])
    shutil.copytree(source / "provenance", package / "provenance", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("__init__.py", "processor.py"):
        shutil.copy(source / name, package)
    (package / "caller.py").write_text(CALLER)
    (package / "callee.py").write_text(CALLEE.format(step=2))
    assert run(tmp_path) == [302, 0]
    (package / "callee.py").write_text(CALLEE.format(step=30))
    assert run(tmp_path) == [3130, 0]
    assert run(tmp_path) == [3130, 1]
