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
from perilune_shared.geometry.frames import site_from_selenographic

SMALL = [
    "--preset=tiny",
    "--kind=detect",
    "--set=dataset.camera.width_px=32",
    "--set=dataset.camera.height_px=32",
    "--set=dataset.render.exr=false",
    "--set=dataset.render.engine=heightfield",
    "--set=dataset.terrain.spacing_px=4",
    "--set=dataset.detect.n_scenes=1",
    "--set=dataset.detect.n_frames=2",
]


def model(path, height_m, pixel_m):
    """A GeoTIFF of heights (n, n) in steps of `pixel_m`."""
    return write(path, height_m, POLAR, rasterio.Affine(pixel_m, 0, 1e5, 0, -pixel_m, 0))


@pytest.mark.parametrize("command", ["plan", pytest.param("dataset", marks=pytest.mark.slow)])
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


def test_a_site_off_the_middle_is_in_the_recipe_and_its_frames_are_made_again(tmp_path):
    height = np.random.default_rng(1).normal(0, 0.3, (201, 201)).cumsum(axis=0)
    dem = model(tmp_path / "a.tif", height, 10.0)
    settings = [
        "--set=dataset.terrain.elevation.site_column_px=50",
        "--set=dataset.terrain.elevation.site_row_px=140.5",
    ]
    for name, more in (("middle", []), ("site", settings)):
        done = in_process.call(main, "dataset", "--workers", 0, *SMALL, *more, "--dem", dem, "--out", tmp_path / name)
        assert done.returncode == 0, done.stderr
    middle, site = (open_dataset(tmp_path / name / "detect") for name in ("middle", "site"))
    assert middle.info.recipe().config["terrain"]["elevation"] == {"outside": "procedural"}
    stated = {"outside": "procedural", "site_column_px": 50.0, "site_row_px": 140.5}
    assert site.info.recipe().config["terrain"]["elevation"] == stated
    places = [made.table("scenes", ["latitude_deg", "longitude_deg"]).to_pylist()[0] for made in (middle, site)]
    x, y = site_from_selenographic(*places[1].values(), *places[0].values())
    assert np.hypot(x, y) == pytest.approx(10 * np.hypot(50.5, 40), rel=0.01)
    shares = [made.table("frames", ["real_ground_share"])["real_ground_share"][0].as_py() for made in (middle, site)]
    assert 0.3 < shares[1] < shares[0] - 0.1
    again = in_process.call(main, "regenerate", "--manifest", site.store.at(""), "--verify", "--all", "--dem", dem)
    assert again.returncode == 0 and "2 frames: 2 identical" in again.stdout, again.stderr
    made = in_process.call(
        main, "dataset", "--manifest", site.store.at(""), "--dem", dem, "--out", tmp_path / "again", "--workers", 0
    )
    assert made.returncode == 0, made.stderr
    hashes = [
        open_dataset(folder).table("frames", ["png_sha256"])["png_sha256"].to_pylist()
        for folder in (site.store.at(""), tmp_path / "again")
    ]
    assert hashes[0] == hashes[1]
