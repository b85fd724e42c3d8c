import numpy as np
import pytest
import rasterio
from tests.helpers.elevation_models import POLAR, write
from tests.helpers.scenes import config_with

from perilune_render.flight.view import view_envelope
from perilune_render.terrain.elevation.model import base_heights, read_elevation
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.scene import grow_scene
from perilune_shared.errors import UserError

LONLAT = "+proj=longlat +R=1737400"
UTM = rasterio.Affine(5, 0, 5e5, 0, -5, 5e6)
METRES_PER_DEGREE = np.pi * 1737400 / 180


def ramp_to_the_north(path, crs=LONLAT):
    """100 x 100 pixels of 20 m at 30 S, 10 E, rising to the north by one metre a pixel."""
    degree = 20 / METRES_PER_DEGREE
    height = np.tile(np.arange(100, 0, -1.0)[:, None], (1, 100))
    return write(path, height, crs, rasterio.Affine(degree / np.cos(np.radians(30)), 0, 10, 0, -degree, -30))


def test_north_is_minus_y(tmp_path):
    model = read_elevation(ramp_to_the_north(tmp_path / "a.tif"))
    assert model.pixel_m == pytest.approx(20, rel=0.01)
    grid = Grid.even(600, 30)
    height, beyond = base_heights(model, grid)
    height = height.reshape(61, 61)
    assert height[30, 30] == 0 and (beyond == 0).all()
    slope = (height[-1, 30] - height[0, 30]) / 1200
    assert slope == pytest.approx(-1 / 20, rel=0.01)
    assert abs(height[30, -1] - height[30, 0]) < 0.5


def test_polar_stereographic_near_the_south_pole(tmp_path):
    # 127 km from the pole along +x, which is longitude 90 E: "south" is -x on the map, so +Y_L must be that way.
    x = np.arange(100.0)[None, :] * np.ones((100, 1))
    model = read_elevation(write(tmp_path / "a.tif", x, POLAR, rasterio.Affine(10, 0, 127_000, 0, -10, 0)))
    assert model.latitude_deg < -85 and model.longitude_deg == pytest.approx(90, abs=0.5)
    height, _ = base_heights(model, Grid.even(300, 15))
    height = height.reshape(31, 31)
    assert height[-1, 15] - height[0, 15] == pytest.approx(-60, rel=0.02)


@pytest.mark.parametrize("middle_deg", [200.0, 359.99, 180.0, -179.995])
def test_rasters_that_count_longitudes_from_0_or_lie_across_180(tmp_path, middle_deg):
    # 100 x 100 pixels of 20 m that rise to the east by one metre a pixel.
    degree = 20 / METRES_PER_DEGREE
    height = np.tile(np.arange(100.0), (100, 1))
    transform = rasterio.Affine(degree, 0, middle_deg - 50 * degree, 0, -degree, 50 * degree)
    model = read_elevation(write(tmp_path / "a.tif", height, LONLAT, transform))
    base, beyond = base_heights(model, Grid.even(600, 30))
    assert (beyond == 0).all()
    base = base.reshape(61, 61)
    assert base[30, 0] - base[30, -1] == pytest.approx(60, rel=0.01)


def test_stored_integers_are_scaled(tmp_path):
    path = ramp_to_the_north(tmp_path / "a.tif")
    plain = read_elevation(path).height_m
    with rasterio.open(path, "r+") as raster:
        raster.scales, raster.offsets = (0.5,), (1000.0,)
    assert np.allclose(read_elevation(path).height_m, 0.5 * plain + 1000)


def test_a_model_far_smaller_than_the_ground_cannot_be_mirrored(tmp_path):
    model = read_elevation(
        write(tmp_path / "a.tif", np.ones((20, 20)), POLAR, rasterio.Affine(0.05, 0, 1e5, 0, -0.05, 0))
    )
    with pytest.raises(UserError, match="a model that covers more of it"):
        base_heights(model, Grid.even(600, 30), "mirror")
    assert np.isfinite(base_heights(model, Grid.even(600, 30))[0]).all()


def test_holes_are_filled_and_the_outside_is_marked(tmp_path):
    height = np.full((60, 60), 5.0)
    height[20:25, 20:25] = -9999
    model = read_elevation(write(tmp_path / "a.tif", height, POLAR, rasterio.Affine(5, 0, 1000, 0, -5, 1000)))
    assert np.allclose(model.height_m, 5)
    base, beyond = base_heights(model, Grid.even(400, 40))
    beyond = beyond.reshape(81, 81)
    assert np.allclose(base, 0, atol=1e-9) and beyond[40, 40] == 0
    # The raster is turned about the site: only distances from the site are known without the projection.
    assert 400 * np.sqrt(2) - 150 * np.sqrt(2) <= beyond[0, 0] <= 400 * np.sqrt(2) - 150
    x, y = Grid.even(400, 40).vertices_xy()
    in_hole = np.hypot(x, y).reshape(81, 81) < 75
    assert 5 < beyond[in_hole].max() < 15 and 0 < (beyond[in_hole] > 0).mean() < 0.1


def test_craters_on_the_model_are_only_those_below_what_it_resolves(tmp_path, camera):
    path = ramp_to_the_north(tmp_path / "a.tif")
    config = config_with(terrain={"dem": str(path), "spacing_px": 1.0})
    scene = grow_scene(config, view_envelope(camera, config.detect.flight), 1)
    inside = np.maximum(np.abs(scene.craters.x_m), np.abs(scene.craters.y_m)) < 1000
    assert inside.sum() > 100 and scene.craters.diameter_m[inside].max() <= 80.5
    assert scene.dem_source.startswith("a.tif sha256:") and scene.latitude_deg == pytest.approx(-30, abs=0.1)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (lambda p: p.unlink(), "no such file"),
        (lambda p: p.write_bytes(b"not a raster"), "readable GeoTIFF"),
        (lambda p: write(p, np.ones((50, 50)), LONLAT, rasterio.Affine.identity()), "pixel size"),
        (lambda p: write(p, np.ones((50, 50)), None, rasterio.Affine(5, 0, 0, 0, -5, 0)), "projection"),
        (lambda p: write(p, np.ones((50, 50)), "EPSG:32633", UTM), "projection: got WGS 84, radius 6378 km, expected"),
        (lambda p: write(p, np.ones((50, 50)), "EPSG:4326", UTM), "projection: got WGS 84"),
        (lambda p: write(p, np.ones((50, 50)), "+proj=longlat +R=3396190", UTM), "radius 3396 km"),
        (lambda p: write(p, np.ones((50, 50)), 'LOCAL_CS["a",UNIT["metre",1]]', UTM), "projection: got a system"),
        (lambda p: write(p, np.full((50, 50), -9999.0), POLAR, rasterio.Affine(5, 0, 0, 0, -5, 0)), "heights"),
    ],
)
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_bad_elevation_models_are_reported_in_one_line(tmp_path, change, part):
    path = ramp_to_the_north(tmp_path / "bad.tif")
    change(path)
    with pytest.raises(UserError, match=part) as caught:
        read_elevation(path)
    assert "bad.tif" in str(caught.value)
