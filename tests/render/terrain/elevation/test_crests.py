"""Rims of catalogued craters measured in an elevation model, against analytic craters."""

import numpy as np
import pytest
import rasterio
from tests.helpers.elevation_models import POLAR, write
from tests.helpers.scenes import config_with

from perilune_render.flight.view import view_envelope
from perilune_render.terrain.elevation.catalogue import read_catalogue
from perilune_render.terrain.elevation.crests import MIN_PIXELS, measure_crests
from perilune_render.terrain.elevation.model import read_elevation
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.scene import grow_scene
from perilune_shared.geometry.frames import selenographic_from_site, site_from_selenographic

PIXEL_M, N = 5.0, 400
AT = rasterio.Affine(PIXEL_M, 0, 30_000, 0, -PIXEL_M, 12_000)


def _places(model):
    """x and y of the pixels in the site's frame."""
    column, row = np.meshgrid(np.arange(N) + 0.5, np.arange(N) + 0.5)
    east, north = AT @ (column, row)
    lon, lat = rasterio.warp.transform(POLAR, "+proj=longlat +R=1737400", east.ravel(), north.ravel())
    return site_from_selenographic(lat, lon, model.latitude_deg, model.longitude_deg)


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    """A tilted, wavy model with 25 elliptic craters, and (x, y, diameter, axis ratio) of each."""
    folder = tmp_path_factory.mktemp("crests")
    x, y = _places(read_elevation(write(folder / "flat.tif", np.zeros((N, N)), POLAR, AT)))
    rng = np.random.default_rng(7)
    height = 0.05 * x - 0.08 * y + 3 * np.sin(x / 200) + 2 * np.cos(y / 150) + rng.normal(0, 0.2, x.shape)
    true = []
    for place in range(25):
        diameter, ratio, turn = rng.uniform(45, 150), rng.uniform(0.85, 1), rng.uniform(0, np.pi)
        centre = 320 * (np.array(divmod(place, 5)) - 2) + rng.uniform(-20, 20, 2)
        u, v = (x - centre[0]) * np.cos(turn) + (y - centre[1]) * np.sin(turn), 0
        v = (y - centre[1]) * np.cos(turn) - (x - centre[0]) * np.sin(turn)
        r = np.hypot(u * np.sqrt(ratio), v / np.sqrt(ratio)) / (diameter / 2)
        rim = np.exp(-(((r - 1) / rng.uniform(0.15, 0.35)) ** 2))
        height += diameter * np.where(r < 1, 0.04 - 0.15 * (1 - r**2), 0.04 * rim)
        true.append((*centre, diameter, ratio))
    path = write(folder / "model.tif", height.reshape(N, N), POLAR, AT)
    return path, np.array(true)


@pytest.mark.parametrize("growth", [0.8, 1.0, 1.18, 1.55])
def test_crests_lie_where_the_ground_is_highest(ground, growth):
    """Growth is the crest's radius divided by the listed one."""
    path, true = ground
    model, rng = read_elevation(path), np.random.default_rng(1)
    listed = true[:, 2] / growth
    found = measure_crests(model, *(true[:, :2] + rng.normal(0, 2, (25, 2))).T, listed)
    large = listed >= MIN_PIXELS * PIXEL_M
    assert not found.found[~large].any()
    assert found.found[large].mean() > 0.9
    own = found.found
    # A raster shows a sharp crest up to half a pixel farther out, where the ground outside is less steep.
    radius_error = (found.diameter_m - true[:, 2])[own] / 2
    assert -0.2 * PIXEL_M < np.median(radius_error) < 0.5 * PIXEL_M
    assert np.abs(radius_error).max() < PIXEL_M
    assert np.hypot(found.x_m - true[:, 0], found.y_m - true[:, 1])[own].max() < 0.4 * PIXEL_M
    assert np.abs(found.axis_ratio - true[:, 3])[own].max() < 0.05
    assert found.rms_share[own].max() < 0.05


def test_no_crest_is_found_where_no_crater_is(ground):
    model, rng = read_elevation(ground[0]), np.random.default_rng(2)
    x, y = rng.uniform(-800, 800, (2, 300))
    true = ground[1]
    apart = np.hypot(x[:, None] - true[:, 0], y[:, None] - true[:, 1]).min(axis=1) > 130
    found = measure_crests(model, x[apart], y[apart], np.full(apart.sum(), 90.0))
    assert apart.sum() > 60
    assert found.found.mean() < 0.03


def test_a_level_model_has_no_crest(tmp_path):
    model = read_elevation(write(tmp_path / "flat.tif", np.zeros((N, N)), POLAR, AT))
    found = measure_crests(model, np.array([0.0, 900.0]), np.zeros(2), np.array([100.0, 400.0]))
    assert not found.found.any()
    assert np.isnan(found.x_m).all()


@pytest.fixture
def catalogue(ground, tmp_path):
    """A catalogue whose diameters are 1.3 times too small; the last crater does not exist."""
    path, true = ground
    model = read_elevation(path)
    rows = [*true[:, :3], (160.0, 160.0, 90.0)]
    lines = ["longitude_deg,latitude_deg,diameter_m"]
    for x, y, diameter in rows:
        latitude, longitude = selenographic_from_site(x, y, model.latitude_deg, model.longitude_deg)
        lines.append(f"{longitude:.8f},{latitude:.8f},{diameter / 1.3:.6f}")
    file = tmp_path / "craters.csv"
    file.write_text("\n".join(lines) + "\n")
    return file


def test_both_diameters_and_the_quality_of_the_fit_are_kept(ground, catalogue):
    path, true = ground
    model, grid = read_elevation(path), Grid.even(1900, 90)
    found = read_catalogue(catalogue, model, grid, config_with().terrain)
    craters, counts = found.craters, found.counts
    measured = np.isfinite(craters.rim_rms_share)
    assert counts.used == 26 and counts.measured == measured.sum() >= 18
    assert str(counts) == f"26 used ({counts.measured} rims measured in the model, {26 - counts.measured} as listed)"
    assert (np.diff(craters.diameter_m) <= 0).all()
    growth = craters.diameter_m / craters.listed_diameter_m
    assert np.median(growth[measured]) == pytest.approx(1.3, rel=0.06)
    assert (growth[~measured] == 1).all()
    assert np.isnan(craters.rim_axis_ratio[~measured]).all()
    listed = read_catalogue(catalogue, model, grid, config_with(terrain={"elevation": {"rims": "catalogue"}}).terrain)
    assert listed.counts.measured == 0
    assert np.allclose(listed.craters.diameter_m, np.sort(np.append(true[:, 2], 90))[::-1] / 1.3)
    assert np.isnan(listed.craters.listed_diameter_m).all()


def test_rims_change_no_height(ground, catalogue, camera):
    terrain = {"dem": str(ground[0]), "catalogue": str(catalogue), "spacing_px": 1.0, "boulders": {"density": 0.0}}
    scenes = []
    for rims in ("measured", "catalogue"):
        config = config_with(terrain={**terrain, "elevation": {"rims": rims}})
        scenes.append(grow_scene(config, view_envelope(camera, config.detect.flight), 1))
    assert np.array_equal(scenes[0].height_m, scenes[1].height_m)
    generated = np.isfinite(scenes[0].craters.age_myr)
    assert np.isnan(scenes[0].craters.listed_diameter_m[generated]).all()
    real = np.isfinite(scenes[0].craters.rim_rms_share)
    # The crest is the highest place, so the depth is larger than below the listed circle.
    assert np.median(scenes[0].rims.depth_m[real] / scenes[0].craters.diameter_m[real]) > 0.1
