"""The map of a site, and whether the site lies in shadow."""

import cv2
import numpy as np
import pytest
import rasterio
from tests.helpers import in_process
from tests.helpers.elevation_models import POLAR, write
from tests.helpers.scenes import flat_scene

from perilune_render.cli.main import main
from perilune_render.preview.site_horizon import site_horizon_of
from perilune_render.preview.site_map import site_map
from perilune_render.terrain.elevation.model import read_elevation
from perilune_shared.geometry.frames import sun_direction

QUICK = [
    "--preset=tiny",
    "--kind=detect",
    "--set=dataset.camera.width_px=32",
    "--set=dataset.camera.height_px=32",
    "--set=dataset.terrain.spacing_px=4",
    "--set=dataset.render.engine=heightfield",
    "--set=dataset.detect.sun.elevation_deg=15",
    "--set=dataset.detect.sun.azimuth_deg=90",
]


def walled(n=201, extent_m=400.0):
    """Flat ground with a wall of 20 m that stands 100 m to 110 m east of the site; rows are y (south), x is west."""
    x = np.linspace(-extent_m / 2, extent_m / 2, n)
    return flat_scene(extent_m, n, height_m=np.tile(np.where((x <= -100) & (x >= -110), 20.0, 0.0), (n, 1)))


def test_the_horizon_is_that_of_the_ground_towards_the_azimuth():
    east = site_horizon_of(walled(), 90.0)
    assert east.elevation_deg == pytest.approx(np.degrees(np.arctan2(20, 100)), abs=0.3)
    assert east.distance_m == pytest.approx(100, abs=2) and east.height_m == pytest.approx(20)
    slanted = site_horizon_of(walled(), 45.0)
    assert slanted.elevation_deg == pytest.approx(np.degrees(np.arctan2(20, 100 * np.sqrt(2))), abs=0.3)
    assert site_horizon_of(walled(), 270.0).elevation_deg == 0


def test_a_slope_that_faces_away_from_the_sun_has_a_horizon():
    _, x = np.mgrid[:101, -50:51] * 4.0
    scene = flat_scene(400, 101, height_m=-np.tan(np.radians(20)) * x)
    assert site_horizon_of(scene, 90.0).elevation_deg == pytest.approx(20, abs=0.01)
    assert site_horizon_of(scene, 270.0).elevation_deg == pytest.approx(-20, abs=0.01)


def test_shadows_fall_away_from_the_sun_and_east_is_right():
    drawn = site_map(walled(), None, sun_direction(90.0, 15.0))
    n = len(drawn.height_m)
    east = (np.arange(n) - n // 2) / (n // 2) * 200
    middle = drawn.sunlit[n // 2]
    # The shadow is 20 m / tan 15 deg = 75 m long, to the west of the wall. Blocks of the map blur its edges.
    assert not middle[(east > 30) & (east < 95)].any() and middle[(east < 20) | (east > 115)].all()
    assert drawn.height_m[n // 2][(east > 102) & (east < 108)].min() > 18
    assert drawn.outline_m is None and drawn.half_width_m == pytest.approx(200, rel=0.01)


def test_the_map_shows_the_whole_model_and_nothing_where_nothing_is_known(tmp_path):
    height = np.zeros((100, 300))
    height[40:60, 250:270] = 30
    path = write(tmp_path / "a.tif", height, POLAR, rasterio.Affine(5, 0, 1e5, 0, -5, 0))
    model = read_elevation(path)
    drawn = site_map(flat_scene(400, 101), model, sun_direction(90.0, 40.0))
    assert drawn.outline_m is not None and drawn.half_width_m == pytest.approx(1.03 * 750, rel=0.02)
    known = np.isfinite(drawn.height_m)
    # The raster and the square of ground around its middle that is beyond it, as shares of the map.
    assert known.mean() == pytest.approx((1500 * 500) / (2 * drawn.half_width_m) ** 2, rel=0.1)
    raised = np.argwhere(drawn.height_m > 15).mean(axis=0)
    # The block is 550 m from the middle along the raster's x, which is north at longitude 90 E: up in the map.
    pixel = 2 * drawn.half_width_m / len(drawn.height_m)
    assert (len(drawn.height_m) / 2 - raised[0]) * pixel == pytest.approx(550, abs=15)
    assert abs(len(drawn.height_m) / 2 - raised[1]) * pixel < 15


def preview(tmp_path, *more):
    done = in_process.call(main, "preview", *QUICK, *more, "--out", tmp_path / "p.png")
    assert done.returncode == 0, done.stderr
    picture = cv2.imread(str(tmp_path / "p-map.png"))
    assert picture.shape[:2] == (940, 1280) and picture.std() > 20
    assert "p-map.png" in done.stdout and (tmp_path / "p.png").exists()
    return [line for line in done.stderr.splitlines() if "shadow" in line], picture


def test_preview_warns_of_a_site_in_shadow_and_only_then(tmp_path):
    column, row = np.meshgrid(np.arange(300) + 0.5, np.arange(300) + 0.5)
    pit = -120 * np.clip(1 - (np.hypot(column - 220, row - 150) / 30) ** 2, 0, None)
    dem = write(tmp_path / "pit.tif", pit, POLAR, rasterio.Affine(10, 0, 1e5, 0, -10, 0))
    warnings, _ = preview(tmp_path, "--dem", dem)
    assert warnings == []
    place = ["--set=dataset.terrain.elevation.site_column_px=220", "--set=dataset.terrain.elevation.site_row_px=150"]
    (warning,), _ = preview(tmp_path, "--dem", dem, *place)
    assert warning.startswith("warning: scene-0000: the site lies in shadow: the Sun at azimuth 90.0 is 15.0 degrees")


def test_procedural_scenes_have_a_map(tmp_path):
    warnings, picture = preview(tmp_path, "--set=dataset.detect.sun.elevation_deg=60")
    assert warnings == []
    # The site's mark is in the middle of the map, and the ground track ends there.
    assert (picture[460:480, 460:480, 2].astype(int) - picture[460:480, 460:480, 0] > 100).any()
