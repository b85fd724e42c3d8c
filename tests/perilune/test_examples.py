"""The three programs that the documentation shows first run as they are."""

import runpy
import sys
from pathlib import Path

import pytest
from PIL import Image
from tests.helpers import in_process

from perilune_train.cli.main import main

ROOT = Path(__file__).parents[2]


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs an example with arguments; returns what it prints."""

    def call(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
        return capsys.readouterr().out

    return call


def test_find_craters(run, tmp_path):
    printed = run("find_craters.py", ROOT / "docs/pictures/lunar_frame.png", tmp_path / "craters.png")
    assert printed.startswith("Craters(") and "radius_px" in printed
    assert Image.open(tmp_path / "craters.png").size == (1024, 1024)


def test_render_scene(run, tmp_path):
    small = ("dataset.camera.width_px=64", "dataset.camera.height_px=64", "dataset.terrain.spacing_px=4")
    printed = run("render_scene.py", tmp_path / "descent.png", *small)
    assert printed.startswith("Scene(mare: ") and "RenderedFrame(64 x 64 px" in printed
    assert Image.open(tmp_path / "descent.png").size == (1024, 1024)


def test_own_detector(run, quick, tmp_path):
    words = ("--dataset", quick / "nav", "--trajectory", "scene-0000/trajectory-0000", "--out", tmp_path / "descent")
    assert in_process.call(main, "navigate", "descent", *words).returncode == 0
    head, *rows = run("own_detector.py", tmp_path / "descent").splitlines()
    assert head.split() == ["time_s", "status", "x_m", "y_m", "z_m", "n_matched"] and len(rows) > 2


def test_read_dataset(run, quick, tmp_path):
    printed = run("read_dataset.py", quick / "detect", tmp_path / "frame.png")
    assert printed.startswith("(8, 1, 128, 128), ")
    assert Image.open(tmp_path / "frame.png").size == (1024, 1024)
