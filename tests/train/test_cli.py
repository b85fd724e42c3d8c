"""The command line as a person meets it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.helpers import in_process
from typer.testing import CliRunner

from perilune_train.cli.main import app, main


def call(*arguments, cwd=None):
    program = Path(sys.executable).parent / "perilune-train"
    return subprocess.run(
        [program, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        check=False,
    )


def test_help_names_the_commands():
    result = CliRunner().invoke(app, ["--help"])
    assert result.exit_code == 0
    for command in ("detect", "navigate", "explain"):
        assert command in result.output


@pytest.mark.parametrize("command", ["detect train", "navigate train", "explain"])
def test_each_command_tells_its_options(command):
    result = CliRunner().invoke(app, [*command.split(), "--help"], env={"COLUMNS": "200"})
    assert result.exit_code == 0
    for option in ("--preset", "--config", "--set", "--dataset", "--runs", "--name"):
        assert option in result.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "detect.epoch=3"], ["detect.epoch", "unknown key", "epochs (nearest known)"]),
        (["--set", "detect.width=-1"], ["detect.width", "-1", "at least 0.125"]),
        (["--set", "detect.epochs=many"], ["detect.epochs", "'many'", "expected an integer"]),
        (["--set", "detect.strides=[8, 16, 64]"], ["detect", "strides 8, 16, 32 or 4, 8, 16"]),
        (["--preset", "smal"], ["preset", "smal", "small (nearest known)"]),
        (["--dataset", "nowhere"], ["nowhere", "dataset.json", "no such file"]),
        (["--config", "nowhere.yaml"], ["nowhere.yaml", "no such file"]),
    ],
)
def test_a_mistake_gets_one_line_exit_code_2_and_leaves_nothing(tmp_path, arguments, words, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = in_process.call(main, "detect", "train", *arguments)
    assert result.returncode == 2
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    for word in words:
        assert word in lines[0]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_mistake_ends_the_process_with_its_line_and_code(tmp_path):
    result = call("detect", "train", "--set", "detect.epoch=3", cwd=tmp_path)
    assert result.returncode == 2 and len(result.stderr.strip().splitlines()) == 1
    assert "epochs (nearest known)" in result.stderr and list(tmp_path.iterdir()) == []


def test_detect_runs(tmp_path, few, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = ["--preset", "tiny", "--name", "x", "--set", "detect.epochs=1", "--set", "detect.precision=float32"]
    result = in_process.call(main, "detect", "train", *given, "--dataset", few)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "runs" / "detect" / "x" / "metrics.json").is_file()
    assert "detections.png" in result.stderr
