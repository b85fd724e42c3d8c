"""Datasets over an elevation model through the command line: refused under its ground, described where it ends."""

import numpy as np
import pytest
import rasterio
from rich.progress import Progress
from tests.helpers import in_process
from tests.helpers.elevation_models import POLAR, write

from perilune_render.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.export.card import write_card

SMALL = [
    "--preset=tiny",
    "--kind=detect",
    "--set=dataset.camera.width_px=32",
    "--set=dataset.camera.height_px=32",
    "--set=dataset.render.exr=false",
    "--set=dataset.terrain.spacing_px=4",
    "--set=dataset.detect.n_scenes=1",
    "--set=dataset.detect.n_frames=2",
]


def model(path, height_m, pixel_m):
    """A GeoTIFF of heights (n, n) in steps of `pixel_m`."""
    return write(path, height_m, POLAR, rasterio.Affine(pixel_m, 0, 1e5, 0, -pixel_m, 0))


@pytest.mark.parametrize("command", ["plan", "dataset"])
def test_a_model_that_puts_the_camera_under_the_ground_is_refused(command, tmp_path):
    # The site, at the model's middle, has height 0. Walls of 2000 m stand where the descent from 1500 m begins.
    y, x = np.mgrid[-150:151, -150:151] * 20.0
    walls = 2000 * np.clip((np.hypot(x, y) - 100) / 300, 0, 1)
    dem, out = model(tmp_path / "walls.tif", walls, 20.0), tmp_path / "out"
    done = in_process.call(main, command, *SMALL, "--dem", dem, "--out", out)
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error")]
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "configuration: dataset.detect: frame scene-0000/trajectory-0000/000000: got a camera -" in line
    assert "m above the ground, expected at least 1 m" in line
    assert [path.name for path in tmp_path.iterdir()] == ["walls.tif"]


def test_the_manifest_and_the_card_say_how_much_ground_is_real(tmp_path):
    # The second frame sees less ground than the first, and so a larger share of the model.
    height = np.random.default_rng(1).normal(0, 0.3, (101, 101)).cumsum(axis=0)
    dem = model(tmp_path / "small.tif", height, 4.0)
    done = in_process.call(main, "dataset", "--workers", 0, *SMALL, "--dem", dem, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    dataset = open_dataset(tmp_path / "out/detect")
    shares = dataset.table("frames", ["real_ground_share"])["real_ground_share"].to_pylist()
    write_card(dataset, tmp_path / "card.md", Progress(disable=True))
    low, high = (f"{100 * share:.0f}" for share in shares)
    assert 0 < shares[0] < 0.5 and shares[1] == 1
    assert f"({low} to {high} %). The rest is procedural." in (tmp_path / "card.md").read_text()
