"""The landing site in an elevation model: a stated place instead of the raster's middle."""

import numpy as np
import pytest
import rasterio
from tests.helpers import in_process
from tests.helpers.elevation_models import POLAR, write

from perilune_render.cli.main import main
from perilune_render.config.terrain import ElevationConfig, TerrainConfig
from perilune_render.terrain.elevation.catalogue import read_catalogue
from perilune_render.terrain.elevation.model import base_heights, raster_places, read_elevation
from perilune_render.terrain.grid import Grid
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import site_from_selenographic

PIXEL_M = 10.0
PLACED = rasterio.Affine(PIXEL_M, 0, 127_000, 0, -PIXEL_M, 0)
CRATER = (150.5, 60.5)
"""Column and row of the middle of a crater in a raster of 200 x 100 pixels."""


@pytest.fixture
def path(tmp_path):
    """A flat raster with a crater of 300 m diameter and 40 m depth off its middle, and a hole."""
    column, row = np.meshgrid(np.arange(200) + 0.5, np.arange(100) + 0.5)
    distance = PIXEL_M * np.hypot(column - CRATER[0], row - CRATER[1])
    height = 500 - 40 * np.clip(1 - (distance / 150) ** 2, 0, None)
    height[10:20, 10:20] = -9999
    return write(tmp_path / "a.tif", height, POLAR, PLACED)


def at(column, row):
    return ElevationConfig(site_column_px=column, site_row_px=row)


def test_a_crater_off_the_middle_is_at_the_site(path):
    grid = Grid.even(300, 60)
    middle, there = read_elevation(path), read_elevation(path, at(*CRATER))
    assert np.ptp(base_heights(middle, grid)[0]) < 0.5
    height, beyond = (values.reshape(121, 121) for values in base_heights(there, grid))
    assert height[60, 60] == 0 and (beyond == 0).all()
    x = np.linspace(-300, 300, 121)
    assert np.allclose(height[60], np.where(np.abs(x) < 150, 40 * (x / 150) ** 2, 40), atol=1.5)
    assert np.allclose(height, height[::-1, ::-1], atol=1.5)


def test_the_site_is_the_origin_of_raster_places_and_of_the_ground_beyond(path):
    model = read_elevation(path, at(190.0, 30.0))
    assert np.allclose(raster_places(model, np.zeros(1), np.zeros(1)), [[190], [30]], atol=1e-6)
    # The raster's right edge is 100 m away; near the pole, at longitude 90 E, it is to the north: -y.
    _, beyond = base_heights(model, Grid.even(400, 40))
    beyond = beyond.reshape(81, 81)
    assert (beyond[60, 40], beyond[40, 40]) == (0, 0) and beyond[0, 40] == pytest.approx(300, abs=3)


def test_a_catalogue_is_placed_about_the_site(path, tmp_path):
    model = read_elevation(path, at(*CRATER))
    row = f"{model.longitude_deg!r},{model.latitude_deg!r},300"
    (tmp_path / "craters.csv").write_text(f"longitude_deg,latitude_deg,diameter_m\n{row}\n")
    listed = TerrainConfig(elevation=ElevationConfig(rims="catalogue"))
    found = read_catalogue(tmp_path / "craters.csv", model, Grid.even(300, 30), listed).craters
    assert len(found) == 1 and np.hypot(found.x_m[0], found.y_m[0]) < 1e-6


def test_pixels_and_coordinates_of_the_same_place_give_the_same_site(path):
    by_pixel = read_elevation(path, at(*CRATER))
    place = {"site_latitude_deg": by_pixel.latitude_deg, "site_longitude_deg": by_pixel.longitude_deg + 0.0}
    by_place = read_elevation(path, ElevationConfig(**place))
    assert (by_place.latitude_deg, by_place.longitude_deg) == (by_pixel.latitude_deg, by_pixel.longitude_deg)
    x, y = site_from_selenographic(*by_pixel.raster.selenographic([100], [50]), *place.values())
    assert np.hypot(x, y) == pytest.approx(PIXEL_M * np.hypot(50.5, 10.5), rel=0.01)


def test_longitudes_may_count_to_360(tmp_path):
    degree = PIXEL_M / (np.pi * 1737400 / 180)
    transform = rasterio.Affine(degree, 0, 200, 0, -degree, 1)
    path = write(
        tmp_path / "a.tif", np.random.default_rng(1).normal(size=(100, 100)), "+proj=longlat +R=1737400", transform
    )
    east, west = (
        read_elevation(path, ElevationConfig(site_latitude_deg=0.99, site_longitude_deg=longitude))
        for longitude in (200.02, 200.02 - 360)
    )
    assert east.longitude_deg == pytest.approx(-159.98) and west.longitude_deg == pytest.approx(-159.98)
    assert raster_places(east, np.zeros(1), np.zeros(1))[0] == pytest.approx(0.02 / degree, abs=1e-5)


def test_the_middle_as_a_stated_site_is_the_default(path):
    default, stated = read_elevation(path), read_elevation(path, at(100.0, 50.0))
    same = (default.latitude_deg, default.longitude_deg, default.pixel_sides_m)
    assert same == (stated.latitude_deg, stated.longitude_deg, stated.pixel_sides_m)


@pytest.mark.parametrize("place", [(0.0, 0.0), (200.0, 100.0), (200.0, 0.0)])
def test_corners_are_sites(path, place):
    model = read_elevation(path, at(*place))
    assert model.pixel_m == pytest.approx(PIXEL_M, rel=0.01)
    assert np.isfinite(base_heights(model, Grid.even(300, 30))[0]).all()


@pytest.mark.parametrize(
    ("site", "message"),
    [
        (at(200.5, 3.0), "site_*_px: got column 200.5, row 3, expected column 0 to 200, row 0 to 100"),
        (at(15.0, 12.0), "got column 15.0, row 12.0, which has no height, expected a pixel with a height; the nearest"),
        (
            ElevationConfig(site_latitude_deg=-85.9, site_longitude_deg=90.0),
            "got latitude -85.9, longitude 90, expected a place in the raster: latitude -85.8",
        ),
        (ElevationConfig(site_latitude_deg=90.0, site_longitude_deg=0.0), "got latitude 90, longitude 0"),
    ],
)
def test_a_site_outside_or_in_a_hole_is_refused(path, site, message):
    with pytest.raises(UserError) as caught:
        read_elevation(path, site)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["site_latitude_deg=-85"], "site_latitude_deg and site_longitude_deg, or site_column_px and site_row_px"),
        (["site_latitude_deg=-85", "site_row_px=3"], "or none of them"),
        (["site_column_px=-1", "site_row_px=3"], "site_column_px: got -1"),
        (["site_column_px=1", "site_row_px=3"], "site_column_px: got 1.0, expected to be set only with --dem"),
        (["site_column_px=1", "site_row_px=a"], "site_row_px: got 'a'"),
    ],
)
def test_bad_settings_are_refused(tmp_path, settings, message):
    given = [f"--set=dataset.terrain.elevation.{setting}" for setting in settings]
    done = in_process.call(main, "plan", "--preset=tiny", *given, "--out", tmp_path / "out")
    assert done.returncode == 2 and message in " ".join(done.stderr.split())
    assert not (tmp_path / "out").exists()
