"""Hazard maps of ground whose slope, roughness, boulders and shadows are known."""

import dataclasses

import numpy as np
import pytest
import rasterio
from pydantic import ValidationError
from tests.helpers.scenes import flat_scene

from perilune_render.config.outputs import HazardConfig
from perilune_render.engines.heightfield.query import heights_m
from perilune_render.engines.heightfield.surface import surface_of
from perilune_render.outputs.hazard import LAYERS, check_hazard, hazard_map, hazard_tiff
from perilune_render.terrain.boulders import Boulders, highest_points
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import sun_direction

CONFIG = HazardConfig(footprint_m=8.0, pixel_m=1.0, extent_m=40.0)
EXTENT_M, SIDE = 64.0, 129
NOON = np.array([0.0, 0.0, 1.0])


def ground(height):
    """A scene of heights given as a function of x and y, O_L."""
    along = np.linspace(-EXTENT_M / 2, EXTENT_M / 2, SIDE)
    x, y = np.meshgrid(along, along)
    return flat_scene(EXTENT_M, SIDE, height_m=height(x, y))


def mapped(scene, config=CONFIG, sun=NOON):
    return hazard_map(surface_of(scene), scene, sun, config).layers


def with_boulder(scene, x_m, y_m, diameter_m):
    one = (np.array([value]) for value in (x_m, y_m, diameter_m))
    boulders = Boulders(*one, np.array([0]), np.array([[1.0, 0.0, 0.0, 0.0]]))
    return dataclasses.replace(scene, boulders=boulders, boulder_z_m=boulders.centre_height_m(np.zeros(1)))


def test_a_tilted_plane_has_its_slope_and_no_roughness():
    # Exact in float32, like the heights of a scene.
    layers = mapped(ground(lambda x, y: 0.125 * x - 0.25 * y))
    assert np.abs(layers["slope"] - np.degrees(np.arctan(np.hypot(0.125, 0.25)))).max() < 1e-6
    assert np.abs(layers["roughness"]).max() < 1e-6
    assert layers["height"].shape == (40, 40)
    # North (-y) is up and east (-x) is right.
    assert layers["height"][0, 0] == pytest.approx(0.125 * 19.5 + 0.25 * 19.5)
    assert not layers["safe"].any() and not layers["boulder"].any() and not layers["shadow"].any()


def test_a_step_gives_the_roughness_of_the_fitted_plane():
    config = CONFIG
    layers = mapped(ground(lambda x, y: np.where(x > 0, 1.0, 0.0)), config)
    # The footprint around the pixel whose centre is 0.5 m east of the step, fitted by NumPy's least squares.
    offset = np.arange(-4, 5)
    down, right = np.meshgrid(offset, offset, indexing="ij")
    disc = np.hypot(down, right) <= 4
    x, y = (-(0.5 + right[disc]), down[disc])
    height = np.where(x > 0, 1.0, 0.0)
    design = np.stack([np.ones(len(x)), x, y], axis=1)
    plane = np.linalg.lstsq(design, height, rcond=None)[0]
    row, column = 20, 20
    assert layers["roughness"][row, column] == pytest.approx(np.abs(height - design @ plane).max(), abs=1e-6)
    assert layers["slope"][row, column] == pytest.approx(np.degrees(np.arctan(np.hypot(*plane[1:]))), abs=1e-5)
    assert layers["roughness"][row, 0] == 0 and layers["safe"][row, 0] == 1
    assert layers["safe"][row, column] == 0


@pytest.mark.parametrize("diameter_m", [2.0, 0.3])
def test_a_boulder_has_its_height_over_the_footprint(diameter_m):
    scene = with_boulder(ground(lambda x, y: 0 * x), -5.5, 3.5, diameter_m)
    layers = mapped(scene)
    x, y, top_m = highest_points(scene.boulders, scene.boulder_z_m, scene.grid, scene.seed)[0]
    assert heights_m(surface_of(scene), np.array([x]), np.array([y]))[0] == pytest.approx(top_m, abs=1e-5)
    assert 0.4 * diameter_m < top_m < 1.1 * diameter_m
    row, column = np.floor([y + 20, -x + 20]).astype(int)
    down, right = np.indices((40, 40)) - np.array([row, column])[:, None, None]
    near = np.hypot(down, right) <= 4
    assert layers["boulder"][near] == pytest.approx(top_m, abs=1e-5)
    assert layers["roughness"][near] == pytest.approx(top_m, abs=1e-5)
    assert not layers["boulder"][np.hypot(down, right) > 4 + diameter_m].any()
    assert layers["safe"][near].all() == (top_m <= CONFIG.max_boulder_m)


def test_a_wall_shadows_what_is_behind_it():
    """A wall 2 m high at x = 0 under a Sun of 45 degrees in the east (-x): its shadow reaches 2 m to the west."""
    scene = ground(lambda x, y: np.where(np.abs(x) < 0.4, 2.0, 0.0))
    config = CONFIG.model_copy(update={"footprint_m": 3.0, "max_shadow_share": 0.1})
    layers = mapped(scene, config, sun_direction(90.0, 45.0))
    share = layers["shadow"][20]
    assert share[25:].max() == 0  # east of the wall
    assert share[18] > 0.5
    assert share[:15].max() == 0
    assert not layers["safe"][20, 18]


def test_the_raster_has_named_bands_north_up_and_the_same_bytes(tmp_path):
    scene = ground(lambda x, y: 0.125 * x)
    hazard = hazard_map(surface_of(scene), scene, NOON, CONFIG)
    content = hazard_tiff(hazard, -30.0, 12.0)
    assert content == hazard_tiff(hazard, -30.0, 12.0)
    (tmp_path / "map.tif").write_bytes(content)
    with rasterio.open(tmp_path / "map.tif") as raster:
        assert raster.descriptions == tuple(LAYERS) and raster.units == tuple(LAYERS.values())
        assert raster.bounds == (-20, -20, 20, 20)
        # O_L's x is the distance to the west.
        ((height,),) = raster.sample([(-10.5, 5.5)], indexes=[1])
        assert height == pytest.approx(0.125 * 10.5)
        assert raster.crs.to_dict()["lat_0"] == -30


def test_places_off_the_map_have_no_values():
    scene = ground(lambda x, y: 0.125 * x)
    hazard = hazard_map(surface_of(scene), scene, NOON, CONFIG)
    found = hazard.at(np.array([19.9, 20.1, 0.0, np.nan]), np.array([0.0, 0.0, -20.1, 0.0]))
    assert np.isfinite(found["slope"]).tolist() == [True, False, False, False]
    assert found["safe"][0] == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"footprint_m": 1.0, "pixel_m": 2.0}, "footprint_m of 3 to 100 pixel_m"),
        ({"footprint_m": 500.0}, "footprint_m of 3 to 100 pixel_m"),
        ({"extent_m": 0.1}, "extent_m of 1 to 2048 pixel_m"),
        ({"extent_m": 5000.0}, "extent_m of 1 to 2048 pixel_m"),
        ({"max_slope_deg": 90.0}, "max_slope_deg"),
    ],
)
def test_impossible_settings_are_refused(changes, message):
    with pytest.raises(ValidationError, match=message):
        HazardConfig(**changes)


def test_a_map_wider_than_the_ground_is_refused():
    grid = ground(lambda x, y: 0 * x).grid
    check_hazard(CONFIG, grid)
    with pytest.raises(UserError, match=r"dataset.hazard.extent_m: got 60, expected at most 55: the ground is 64 m"):
        check_hazard(CONFIG.model_copy(update={"extent_m": 60.0}), grid)
