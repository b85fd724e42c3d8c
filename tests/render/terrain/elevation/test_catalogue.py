import dataclasses

import numpy as np
import pytest
import rasterio
from tests.helpers.elevation_models import POLAR, write
from tests.helpers.scenes import config_with

from perilune_render.flight.view import view_envelope
from perilune_render.terrain.craters.population import ORIGINS
from perilune_render.terrain.elevation.catalogue import read_catalogue
from perilune_render.terrain.elevation.model import raster_places, read_elevation
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.scene import grow_scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import selenographic_from_site

PIXEL_M = 5.0
CRATERS = [(120.0, -80.0, 160.0), (-200.0, 150.0, 90.0)]
GRID = Grid.even(900, 90)


@pytest.fixture
def model(tmp_path):
    """An elevation model near the south pole with two bowls at known places of its site's frame."""
    flat = read_elevation(write(tmp_path / "flat.tif", np.zeros((400, 400)), POLAR, placed()))
    column, row = np.meshgrid(np.arange(400) + 0.5, np.arange(400) + 0.5)
    east, north = placed() @ (column, row)
    lon, lat = rasterio.warp.transform(POLAR, "+proj=longlat +R=1737400", east.ravel(), north.ravel())
    from perilune_shared.geometry.frames import site_from_selenographic

    x, y = site_from_selenographic(lat, lon, flat.latitude_deg, flat.longitude_deg)
    height = np.zeros(400 * 400)
    for cx, cy, d in CRATERS:
        r = np.hypot(x - cx, y - cy) / (d / 2)
        height += d * np.where(r < 1, -0.12 * (1 - r**2), 0) + d * 0.03 * np.exp(-(((r - 1) / 0.2) ** 2))
    return read_elevation(write(tmp_path / "a.tif", height.reshape(400, 400), POLAR, placed()))


def placed():
    return rasterio.Affine(PIXEL_M, 0, 30_000, 0, -PIXEL_M, 12_000)


def written(path, model, rows, header="longitude_deg,latitude_deg,diameter_m,name"):
    lines = [header]
    for x, y, diameter in rows:
        latitude, longitude = selenographic_from_site(x, y, model.latitude_deg, model.longitude_deg)
        lines.append(f"{longitude:.8f}, {latitude:.8f}, {diameter}, crater")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_places_and_sizes_come_back_largest_first(tmp_path, model):
    rows = [*CRATERS[::-1], (5000.0, 0.0, 300.0)]
    craters = read_catalogue(written(tmp_path / "c.csv", model, rows), model, GRID, config_with().terrain.craters, 20.0)
    assert np.allclose(np.stack([craters.x_m, craters.y_m, craters.diameter_m], axis=1), CRATERS, atol=0.05)
    assert [ORIGINS[k] for k in craters.origin] == ["elevation model"] * 2 and np.isnan(craters.age_myr).all()


def test_only_what_the_model_itself_shows_is_taken(tmp_path, model):
    # Below what it resolves; on a hole; beyond the raster, where the ground is invented; with a rim off the grid.
    unfit = [(50.0, 60.0, 15.0), (300.0, 300.0, 80.0), (-1100.0, 0.0, 150.0), (0.0, 870.0, 100.0)]
    holed = dataclasses.replace(model, known=model.known.copy())
    column, row = raster_places(model, np.array([300.0]), np.array([300.0]))
    holed.known[int(row[0]), int(column[0])] = False
    path = written(tmp_path / "c.csv", model, [*CRATERS, *unfit])
    assert len(read_catalogue(path, holed, Grid.even(1500, 90), config_with().terrain.craters, 20.0)) == 3
    assert len(read_catalogue(path, holed, GRID, config_with().terrain.craters, 20.0)) == 2


def test_real_craters_are_measured_on_the_model_and_kept_beside_ours(tmp_path, model, camera):
    path = written(tmp_path / "c.csv", model, CRATERS)
    config = config_with(
        terrain={
            "dem": str(tmp_path / "a.tif"),
            "catalogue": str(path),
            "spacing_px": 1.0,
            "boulders": {"density": 0.0},
        }
    )
    scene = grow_scene(config, view_envelope(camera, config.detect.flight), 1)
    real = scene.craters.origin == ORIGINS.index("elevation model")
    assert real.sum() == 2 and len(scene.craters) > 100
    assert np.allclose(scene.rims.depth_m[real] / scene.craters.diameter_m[real], 0.14, atol=0.03)
    inside = ~real & (np.hypot(scene.craters.x_m, scene.craters.y_m) < 1000)
    assert (scene.craters.diameter_m[inside] <= 4 * PIXEL_M * 1.01).all()
    without = grow_scene(
        config.model_copy(update={"terrain": config.terrain.model_copy(update={"catalogue": None})}),
        view_envelope(camera, config.detect.flight),
        1,
    )
    # A catalogue names what is there: it changes no height.
    assert np.array_equal(scene.height_m, without.height_m)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (None, "no such file"),
        ("", "longitude_deg"),
        ("lon,lat,d\n1,2,3\n", "longitude_deg: got columns lon, lat, d"),
        ("longitude_deg,latitude_deg,diameter_m\n1,2,3\n1,95,3\n", "c.csv:3: latitude_deg: got 95"),
        ("longitude_deg,latitude_deg,diameter_m\n1,2,nan\n", "c.csv:2: diameter_m: got nan"),
        ("longitude_deg,latitude_deg,diameter_m\n1,2\n", "c.csv:2: diameter_m: got nothing"),
        ("longitude_deg,latitude_deg,diameter_m\n1,2,-5\n", "c.csv:2: diameter_m: got -5"),
    ],
)
def test_faults_are_reported_with_their_line(tmp_path, model, text, part):
    path = tmp_path / "c.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError, match=part):
        read_catalogue(path, model, GRID, config_with().terrain.craters, 20.0)
