"""Ctrl-C at any moment ends every program and script in one line, with exit code 130, within three seconds."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml

from perilune_shared.client import SceneClient
from perilune_shared.errors import STOPPED, UserError
from tests.helpers.rendered import QUICK
from tests.hostile.commands import make_inputs

ROOT = Path(__file__).parent.parent.parent
BEGUN = """
import sys, runpy
from perilune_shared.console.interrupts import end_at_interrupt
end_at_interrupt()
print("begun", flush=True)
"""
"""From here on nothing but one line may come; before it Python itself starts, which takes 20 ms."""
PROGRAMS = {
    "perilune-manifest stats": ("perilune_shared.cli", "stats", "drawn/detect"),
    "perilune-render preview": ("perilune_render.cli", "preview", "--preset", "tiny", "--out", "p.png", *QUICK),
    "perilune-render plan": ("perilune_render.cli", "plan", "--preset", "tiny", "--out", "plan"),
    "perilune-render dataset": ("perilune_render.cli", "dataset", "--preset", "tiny", "--out", "data"),
    "perilune-train detect train": (
        "perilune_train.cli", "detect", "train", "--preset", "tiny", "--dataset", "drawn/detect",
        "--set", "detect.epochs=500",
    ),
    "perilune-train detect evaluate": (
        "perilune_train.cli", "detect", "evaluate", "--dataset", "drawn/detect", "--out", "evaluated",
    ),
    "perilune-train navigate train": (
        "perilune_train.cli", "navigate", "train", "--preset", "tiny", "--dataset", "drawn/nav",
    ),
}  # fmt: skip
SCRIPTS = sorted(path.name for path in (ROOT / "scripts").glob("*.py") if "__main__" in path.read_text())
DELAYS_S = (0.0, 0.1, 0.3, 0.8, 1.5, 2.5, 4.0, 7.0)
MOST_S = 3.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("interrupted")
    make_inputs(folder)
    return folder


def interrupted(code: str, words: tuple[str, ...], folder: Path, after_s: float) -> tuple[int, str, float]:
    """Run Python code in a process group, as a terminal does, and press Ctrl-C; exit code, output, time to the end."""
    command = [sys.executable, "-c", BEGUN + code, *words]
    process = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    time.sleep(after_s)
    pressed = time.monotonic()
    ended_before = process.poll() is not None
    if not ended_before:
        os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=60)
    return process.returncode if not ended_before else 130, error, time.monotonic() - pressed


def check(code: int, error: str, seconds: float, *, lines: int = 0) -> None:
    assert "Traceback" not in error and "Exception ignored" not in error, error[-3000:]
    assert code in (130, 0), f"{code}\n{error[-3000:]}"  # 0: it ended in this moment
    assert lines <= error.count(STOPPED) <= 1, error[-2000:]
    if code == 130 and STOPPED in error:
        assert error.rstrip().endswith(STOPPED), error[-2000:]
    assert seconds <= MOST_S, f"{seconds:.1f} s\n{error[-2000:]}"


@pytest.mark.parametrize("after_s", DELAYS_S)
@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_ends_with_one_line(name, after_s, folder):
    package, *words = PROGRAMS[name]
    check(*interrupted(f"from {package} import main\nmain()", tuple(words), folder, after_s))


@pytest.mark.parametrize("after_s", DELAYS_S[:4])
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_ends_with_one_line(name, after_s, folder):
    check(*interrupted(script(name), ("--help",), folder, after_s))


@pytest.mark.parametrize("after_s", [1.5, 3.0, 4.5])
def test_a_script_and_the_program_that_it_runs_end_with_one_line(after_s, folder, tmp_path):
    check(*interrupted(script("try_render.py"), (str(tmp_path),), folder, after_s), lines=1)


def script(name: str) -> str:
    """Python code that runs a script, either as `python scripts/name.py` or as `python -m scripts.name`."""
    path = ROOT / "scripts" / name
    code = f"sys.path[:0] = {[str(path.parent), str(ROOT)]!r}\nsys.argv[0] = {str(path)!r}\n"
    return code + f"runpy.run_path({str(path)!r}, run_name='__main__')"


LARGE = {
    "camera": {"width_px": 1024, "height_px": 1024, "horizontal_fov_deg": 40.0},
    "terrain": {"spacing_px": 4.0},
    "render": {"samples": 4, "engine": "heightfield"},
    "scene": {"views": [{"height_m": 300, "reach_m": 400}]},
}


@pytest.mark.parametrize("after_s", [0.0, 0.4, 1.0])
def test_a_server_in_a_large_request_ends_with_one_line(folder, after_s):
    (folder / "large.yaml").write_text(yaml.safe_dump({"dataset": LARGE}))
    words = ["serve", "--preset", "tiny", "--scene", "large.yaml", "--port", "0", "--native-port", "0"]
    command = [sys.executable, "-c", "from perilune_render.cli import main; main()", *words]
    process = subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stderr is not None
    for line in process.stderr:
        if found := re.search(r"perilune_shared\.client at (tcp://\S+)", line):
            break
    assert found is not None
    client = threading.Thread(target=ask, args=(found[1],))
    client.start()
    time.sleep(after_s)
    pressed = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    error = process.stderr.read()
    process.wait(60)
    seconds = time.monotonic() - pressed
    client.join(60)
    check(process.returncode, error, seconds)
    assert process.returncode == 130 and STOPPED in error


def ask(address: str) -> None:
    with SceneClient(address, timeout_s=5) as scene, contextlib.suppress(UserError):
        scene.frame((0.0, 0.0, 300.0), (0.0, 1.0, 0.0, 0.0), depth=True, labels=True)


def test_every_script_listens_before_it_imports_libraries():
    missing = []
    for name in SCRIPTS:
        lines = (ROOT / "scripts" / name).read_text().splitlines()
        imports = [line for line in lines if line.startswith(("import ", "from "))]
        third = [n for n, line in enumerate(lines) if line.startswith(("import ", "from ")) and not _is_standard(line)]
        first = lines[third[0]] if third else ""
        if imports and third and first != "from perilune_shared.console.interrupts import end_at_interrupt":
            missing.append(name)
    assert missing == []


def _is_standard(line: str) -> bool:
    return line.split()[1].split(".")[0] in sys.stdlib_module_names
