"""The program behind `make demo`: what runs beside what, Ctrl-C, and errors."""

import importlib.util
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CHILD = """
import pathlib, signal, sys, time
name, times = pathlib.Path(sys.argv[1]), 0
def count(*_):
    global times
    times += 1
signal.signal(signal.SIGINT, count)
name.with_suffix(".ready").touch()
while not times:
    time.sleep(0.01)
time.sleep(0.3)  # for a second signal
name.write_text(str(times))
print("stopped", file=sys.stderr)
sys.exit(130)
"""
"""A command that counts how often it is interrupted."""


@pytest.fixture
def script():
    """The module scripts/demo.py."""
    spec = importlib.util.spec_from_file_location("demo_script", ROOT / "scripts" / "demo.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


class Recorded:
    """Takes the place of the processes: keeps the titles, and makes what the steps look for."""

    def __init__(self, demo):
        self.demo, self.titles, self.commands = demo, [], []
        self.started_s, self.elapsed_s = {}, 0.0

    def start(self, title, command, log=None):
        self.titles.append(title)
        self.started_s[title] = 0.0
        self.commands.append(command)
        return title

    def run(self, title, command):
        self.end(self.start(title, command))

    def end(self, process, log=None):
        self.titles.append(f"end: {process}")


def complete(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "dataset.json").write_text(json.dumps({"complete": True}))


def test_navigation_frames_are_rendered_while_the_detector_trains(script, tmp_path):
    demo = script.Demo("demo", tmp_path / "data", tmp_path / "runs", ("--preset", "demo"), ("--dem", "a.tif"))
    made = Recorded(demo)
    script.run_steps(demo, made)
    beside = "render navigation frames in the background"
    train, end = made.titles.index("train the detector"), made.titles.index(f"end: {beside}")
    assert made.titles.index(beside) < train < end < made.titles.index("train the navigators")
    times = json.loads((demo.runs / "report/demo/demo.json").read_text())
    assert next(iter(times["started_s"])) == "render detection frames"
    # The preset reaches each command that has settings.
    assert sum("--preset" in command for command in made.commands) == 5
    assert ["--dem" in command for command in made.commands] == [c[0] == "perilune-render" for c in made.commands]


def test_finished_frames_are_not_rendered_again(script, tmp_path):
    demo = script.Demo("demo", tmp_path / "data", tmp_path / "runs", ("--preset", "demo"))
    for kind in ("detect", "nav"):
        complete(demo.data / kind)
    made = Recorded(demo)
    script.run_steps(demo, made)
    assert not any("render" in title for title in made.titles)
    assert not (demo.runs / "report/demo/demo.json").exists()


def test_ctrl_c_reaches_both_sides_once(tmp_path):
    code = f"""
import sys
sys.argv[0] = "demo"
import importlib.util
from pathlib import Path
spec = importlib.util.spec_from_file_location("demo_script", {str(ROOT / "scripts" / "demo.py")!r})
demo = importlib.util.module_from_spec(spec)
sys.modules["demo_script"] = demo
spec.loader.exec_module(demo)
folder, child = Path({str(tmp_path)!r}), {CHILD!r}
def steps(given, processes):
    processes.start("behind", ["python", "-c", child, str(folder / "behind")], folder / "behind.log")
    processes.run("in front", ["python", "-c", child, str(folder / "front")])
demo.run_steps = steps
demo.main("tiny", None, None, "x", folder / "data", folder / "runs")
"""
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    while not all((tmp_path / f"{name}.ready").exists() for name in ("behind", "front")):
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors == "stopped\n"  # of the command in front
    assert [(tmp_path / name).read_text() for name in ("behind", "front")] == ["1", "1"]


def test_a_failed_command_ends_the_demo_with_its_code(script, tmp_path, capfd):
    processes, log = script.Processes(), tmp_path / "log"
    fails = ["python", "-c", "import sys; print('error: no space'); sys.exit(2)"]
    waiting = processes.start("waits", ["python", "-c", CHILD, str(tmp_path / "waits")], tmp_path / "waits.log")
    while not (tmp_path / "waits.ready").exists():
        assert waiting.poll() is None
    with pytest.raises(SystemExit) as end:
        processes.end(processes.start("fails", fails, log), log)
    assert end.value.code == 2
    assert "error: no space" in capfd.readouterr().err
    assert waiting.returncode == 130


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (("--preset", "tny"), "error: --preset: got tny, expected tiny (nearest known)"),
        (("--set", "explain.n_frame=4"), "error: --set: explain.n_frame: got an unknown key, expected n_frames"),
        (("--config", "nowhere.yaml"), "error: nowhere.yaml: configuration: got no such file"),
    ],
)
def test_a_mistake_is_found_before_the_first_step(tmp_path, given, expected):
    place = ["--data", tmp_path / "data", "--runs", tmp_path / "runs"]
    done = subprocess.run([sys.executable, ROOT / "scripts/demo.py", *place, *given], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith(expected) and done.stderr.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_a_file_in_place_of_a_folder(tmp_path):
    (tmp_path / "data").touch()
    command = [sys.executable, ROOT / "scripts" / "demo.py", "--data", tmp_path / "data", "--runs", tmp_path / "runs"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (
        2,
        f"error: {tmp_path / 'data'}: folder: got a file, expected a folder, or nothing\n",
    )
    assert not (tmp_path / "runs").exists()
