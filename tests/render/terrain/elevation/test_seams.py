"""Heights across the edges of maps of the whole Moon, and over its poles, against the source on both sides."""

import numpy as np
import pytest
import rasterio
from tests.helpers.elevation_models import MOON, moon_raster, smooth_moon, write

from perilune_render.config.terrain import ElevationConfig
from perilune_render.terrain.elevation import window
from perilune_render.terrain.elevation.model import base_heights, read_elevation
from perilune_render.terrain.grid import Grid
from perilune_shared.geometry.frames import selenographic_from_site

R = 1737400.0
AROUND = np.pi * R


def longlat(first):
    return MOON, rasterio.Affine(0.5, 0, first, 0, -0.5, 90), (360, 720)


def cylindrical(projection, first_deg, lat_ts=0.0):
    """720 columns from a longitude on, rows of half a degree or as many metres, to 80 degrees or to the poles."""
    wide, high = AROUND * np.cos(np.radians(lat_ts)) / 360, AROUND / 360
    rows = 360 if projection == "eqc" else 300
    crs = f"+proj={projection} +lat_ts={lat_ts} +R=1737400 +units=m"
    return crs, rasterio.Affine(wide, 0, first_deg * 2 * wide, 0, -high, rows / 2 * high), (rows, 720)


def polar(projection, latitude, far_m):
    crs = f"+proj={projection} +lat_0={latitude} +R=1737400 +units=m"
    return crs, rasterio.Affine(far_m / 200, 0, -far_m, 0, -far_m / 200, far_m), (400, 400)


MAPS = {
    "longlat from -180": longlat(-180),
    "longlat from 0": longlat(0),
    "eqc from -180": cylindrical("eqc", -180),
    "eqc from 0": cylindrical("eqc", 0),
    "eqc of latitude 30 from 0": cylindrical("eqc", 0, 30.0),
    "mercator from -180": cylindrical("merc", -180),
    "equal area from 0": (
        "+proj=cea +R=1737400 +units=m",
        rasterio.Affine(AROUND / 360, 0, 0, 0, -R / 180, R),
        (360, 720),
    ),
    "sinusoidal": (
        "+proj=sinu +R=1737400 +units=m",
        rasterio.Affine(AROUND / 360, 0, -AROUND, 0, -AROUND / 360, AROUND / 2),
        (360, 720),
    ),
    "stereographic": polar("stere", -90, 1e6),
    "azimuthal": polar("laea", 90, 1e6),
}


def worst(path, latitude, longitude, ground_m=300_000.0, **settings):
    """Largest error of heights relative to the site, metres, and share of the ground that is real."""
    config = ElevationConfig(site_latitude_deg=latitude, site_longitude_deg=longitude, **settings)
    model = read_elevation(path, config, ground_m)
    grid = Grid.even(ground_m / 2, 60)
    height, beyond = base_heights(model, grid)
    there = smooth_moon(*selenographic_from_site(*grid.vertices_xy(), latitude, longitude))
    error = np.abs(height - there + smooth_moon(latitude, longitude))
    return error[beyond == 0].max(), (beyond == 0).mean()


@pytest.mark.parametrize("name", [name for name in MAPS if name not in ("stereographic", "azimuthal")])
def test_both_sides_of_every_seam(tmp_path, name):
    path = moon_raster(tmp_path / "moon.tif", *MAPS[name])
    for latitude, longitude in ((10.3, 179.8), (-35.0, -179.9), (0.0, 180.0), (20.0, 0.0), (-50.0, 359.7)):
        error, real = worst(path, latitude, longitude)
        if name == "sinusoidal":  # the pixels on the map's curved edge are not known
            assert error < 60 and real > 0.9, (longitude, error, real)
        else:
            assert error < 2 and real == 1, (longitude, error, real)


@pytest.mark.parametrize("name", [name for name in MAPS if name.startswith(("longlat", "eqc", "equal"))])
def test_over_the_poles_of_cylindrical_maps(tmp_path, name):
    path = moon_raster(tmp_path / "moon.tif", *MAPS[name])
    # Rows of the same area are a hundred kilometres wide at the poles.
    most = 400 if name.startswith("equal") else 10
    for latitude, longitude in ((90.0, 0.0), (-90.0, 50.0), (89.9, 178.0), (-87.0, -3.0), (86.0, 120.0)):
        error, real = worst(path, latitude, longitude)
        assert error < most and real == 1, (latitude, longitude, error, real)


@pytest.mark.parametrize(("name", "sign"), [("stereographic", -1), ("azimuthal", 1)])
def test_over_the_pole_of_polar_maps(tmp_path, name, sign):
    path = moon_raster(tmp_path / "moon.tif", *MAPS[name])
    for latitude, longitude in ((90.0, 0.0), (89.9, 178.0), (85.0, 180.0)):
        error, real = worst(path, sign * latitude, longitude)
        assert error < 2 and real == 1, (latitude, longitude, error, real)


def test_large_maps_are_read_by_window_across_the_seam_too(tmp_path, monkeypatch):
    path = moon_raster(tmp_path / "moon.tif", *MAPS["longlat from 0"])
    monkeypatch.setattr(window, "LARGEST_PIXELS", 20_000)
    for latitude, longitude in ((10.0, 0.1), (-20.0, 359.9), (30.0, 100.0), (75.0, 0.0)):
        error, real = worst(path, latitude, longitude)
        assert error < 2 and real == 1, (longitude, error, real)
    for latitude, longitude in ((90.0, 0.0), (-88.0, 170.0)):
        error, real = worst(path, latitude, longitude)
        assert error < 60 and real == 1, (latitude, error, real)
    # Wider ground has wider pixels: 700 km at 20,000 pixels.
    error, real = worst(path, 0.0, 0.0, 2_000_000.0)
    assert error < 20 and real == 1


def test_a_map_that_lacks_a_column_has_a_hole_at_its_seam(tmp_path):
    crs, transform, (rows, columns) = MAPS["longlat from -180"]
    path = moon_raster(tmp_path / "moon.tif", crs, transform, (rows, columns - 1))
    error, real = worst(path, 10.0, 180.0)
    assert error < 100 and 0.9 < real < 1


def test_a_map_with_its_first_column_twice(tmp_path):
    crs, transform, (rows, columns) = MAPS["longlat from -180"]
    path = moon_raster(tmp_path / "moon.tif", crs, transform, (rows, columns + 1))
    error, real = worst(path, 10.0, 180.0)
    assert error < 2 and real == 1


@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_regional_maps_that_count_eastwards_over_360(tmp_path, turns):
    """A site at 340 E in a projected map whose x is that of 340 degrees, or of -20 or 700."""
    wide = 5 / np.cos(np.radians(20))
    crs, x, y = "+proj=eqc +R=1737400 +units=m", R * np.radians(340 + 360 * turns), R * np.radians(-20)
    transform = rasterio.Affine(wide, 0, x - 200 * wide, 0, -5, y + 1000)
    column, row = np.meshgrid(np.arange(400.0), np.arange(400.0))
    path = write(tmp_path / "a.tif", 30 * np.sin(column / 40) + row / 10, crs, transform)
    for longitude in (340.0, -20.0):
        model = read_elevation(path, ElevationConfig(site_latitude_deg=-20, site_longitude_deg=longitude))
        height, beyond = base_heights(model, Grid.even(400, 50))
        assert (beyond == 0).all() and model.longitude_deg == pytest.approx(-20)
        # x of O_L points west.
        assert height.reshape(101, 101)[50, 0] == pytest.approx(30 * (np.sin(279.5 / 40) - np.sin(199.5 / 40)), abs=0.1)
