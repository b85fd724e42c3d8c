import dataclasses
import re

import numpy as np
import pytest
from tests.helpers import elevation_models
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import DatasetConfig, FlightConfig
from perilune_render.config.values import Span
from perilune_render.flight.plan import make_plan
from perilune_render.flight.trajectories import fly
from perilune_render.flight.view import view_envelope
from perilune_render.terrain import cache
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.grid import Grid, graded_grid
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.level_ground import averaged, on_level
from perilune_render.terrain.levels import checked_grid, cut_levels, level_index
from perilune_render.terrain.scene import grow_scene
from perilune_shared.config.resolve import resolve
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory, approach_deg

CAMERA = Camera.from_field_of_view(256, 256, 50.0)
FLIGHT = FlightConfig()
VIEW = view_envelope(CAMERA, FLIGHT)
SMALL = Camera.from_field_of_view(96, 96, 50.0)
MOST = 240_000


def small_config(**terrain):
    return config_with(terrain={"max_vertices": MOST, **terrain})


@pytest.fixture(scope="module")
def scene():
    config = small_config()
    return grow_scene(config, view_envelope(SMALL, config.detect.flight), 5)


@pytest.fixture(scope="module")
def levels(scene):
    return cut_levels(small_config().terrain, scene.view, 0)


def test_one_mesh_that_fits_is_the_only_level():
    terrain = config_with().terrain
    (level,) = cut_levels(terrain, VIEW, 0)
    whole = graded_grid(terrain, VIEW)
    assert level.highest_m == np.inf and level.grid.n_half == whole.n_half
    assert np.array_equal(level.grid.half_widths_m, whole.half_widths_m)


@pytest.mark.parametrize("kind", ["detect", "nav"])
@pytest.mark.parametrize("preset", ["tiny", "small", "paper", "large"])
def test_every_preset_renders_a_megapixel(preset, kind):
    large = ("dataset.camera.width_px=1024", "dataset.camera.height_px=1024")
    config = resolve(DatasetConfig, "dataset", "perilune_render", preset, settings=large)
    view = make_plan(config, kind).view
    for approach in (0, 45, 200):
        levels = cut_levels(config.terrain, view, approach)
        assert 10 <= len(levels) <= 14
        assert all(level.grid.n_vertices <= 12_000_000 for level in levels)
        assert (np.diff([level.highest_m for level in levels]) > 0).all() and levels[-1].highest_m == np.inf
        whole = graded_grid(config.terrain, view)
        assert np.allclose([level.grid.extent_m for level in levels], whole.extent_m)


@pytest.mark.parametrize("sigma_deg", [pytest.param(0.3, marks=pytest.mark.slow), 1.0])
def test_every_frame_sees_half_a_pixel_or_finer_ground_on_its_level(sigma_deg):
    """The ground is flat here; the levels allow for ground that rises by a twentieth of the altitude."""
    flight = FlightConfig(azimuth_deg=Span(low=0, high=360), attitude_sigma_deg=sigma_deg)
    terrain, view = config_with(terrain={"max_vertices": 1_000_000}).terrain, view_envelope(CAMERA, flight)
    edge = np.linspace(0, 256, 9)
    points = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(-1, 2)
    for seed in range(30):
        flown = fly(flight, 40, seed)
        levels = cut_levels(terrain, view, flown.nominal.approach_deg)
        assert len(levels) > 3
        rays = np.einsum("nji,kj->nki", flown.rotation_camera_from_site, CAMERA.rays(points))
        ground = flown.position_m[:, None] + rays * flown.position_m[:, None, 2:] / -rays[..., 2:]
        for position, place in zip(flown.position_m, ground, strict=True):
            grid = levels[level_index(levels, position[2])].grid
            spacing = grid.spacing_under(place[:, 0], place[:, 1])
            assert spacing.max() <= 0.505 * position[2] / CAMERA.fx_px


@pytest.mark.parametrize("most", [50_000, 250_000, 600_000])
def test_too_many_vertices_for_any_level_are_refused_and_a_spacing_is_named_that_fits(most):
    with pytest.raises(UserError, match=r"dataset.terrain.spacing_px: got 0.5 needs [67]..,... vertices") as refusal:
        checked_grid(config_with(terrain={"max_vertices": most}).terrain, VIEW)
    named = float(re.search(r"at least ([0-9.]+),", refusal.value.expected)[1])
    wider = config_with(terrain={"max_vertices": most, "spacing_px": named})
    assert all(level.grid.n_vertices <= most for level in cut_levels(wider.terrain, VIEW, 0))
    finer = config_with(terrain={"max_vertices": most, "spacing_px": round(named - 0.01, 2)})
    with pytest.raises(UserError, match="spacing_px"):
        cut_levels(finer.terrain, VIEW, 0)


def test_a_mesh_that_no_spacing_makes_small_enough_names_none():
    own = dataclasses.replace(VIEW, seen=None)
    with pytest.raises(UserError, match=r"expected a larger dataset.terrain.max_vertices, fewer or wider pixels"):
        checked_grid(config_with(terrain={"max_vertices": 10_000}).terrain, own)


def test_a_users_own_view_allows_one_mesh_only():
    own = ViewEnvelope(VIEW.height_m, VIEW.reach_m, VIEW.focal_px)
    with pytest.raises(UserError, match=r"got 0.5 needs 4,...,... vertices"):
        checked_grid(config_with(terrain={"max_vertices": 1_500_000}).terrain, own)


def test_the_approach_is_the_azimuth_of_the_start():
    for azimuth in (0.0, 17.3, 89.9, 180.0, 270.2, 359.4):
        assert NominalTrajectory.parabola(1500, 200, 500, azimuth, 65).approach_deg == round(azimuth)
    assert NominalTrajectory.parabola(1500, 200, 500, 359.7, 65).approach_deg == 0
    assert approach_deg((0.0, 0.0, 1500.0)) == 0


def test_a_plane_keeps_its_values_on_a_level(levels):
    whole = graded_grid(small_config().terrain, view_envelope(SMALL, FLIGHT))
    x, y = whole.vertices_xy()
    for level in levels:
        own_x, own_y = level.grid.vertices_xy()
        plane = averaged((0.2 * x - 0.1 * y).astype(np.float32), whole, level.grid)
        inside = np.maximum(np.abs(own_x), np.abs(own_y)) < 0.9 * whole.extent_m / 2
        error = plane - (0.2 * own_x - 0.1 * own_y)
        assert np.abs(error[inside]).max() < 0.01 * level.grid.spacings_m.min()


def test_detail_within_a_cell_is_averaged():
    """White noise on 64 vertices per cell."""
    noise = np.random.default_rng(3).normal(size=401**2).astype(np.float32)
    mean = averaged(noise, Grid.even(100.0, 200), Grid.even(80.0, 20))
    assert 0.08 < mean.std() < 0.14
    assert averaged(noise, Grid.even(100.0, 200), Grid.even(100.0, 200)) == pytest.approx(noise, abs=1e-6)


def test_all_levels_show_the_ground_of_the_scene(scene, levels):
    assert len(levels) >= 3
    assert_same_ground(scene, levels)


@pytest.mark.parametrize("outside", ["procedural", pytest.param("mirror", marks=pytest.mark.slow)])
def test_all_levels_show_the_ground_of_an_elevation_model(tmp_path, outside):
    """The model covers a part of the ground in view."""
    dem = elevation_models.write(
        tmp_path / "model.tif", elevation_models.rough(n=200), elevation_models.POLAR, elevation_models.PLACED
    )
    config = small_config(dem=str(dem), elevation={"outside": outside})
    scene = grow_scene(config, view_envelope(SMALL, config.detect.flight), 5)
    levels = cut_levels(config.terrain, scene.view, 30)
    assert_same_ground(scene, levels)
    x, y = np.random.default_rng(2).uniform(-1, 1, (2, 2000)) * scene.grid.extent_m / 2
    for level in levels:
        shown = on_level(scene, level.grid, config.terrain.boulders)
        real, expected = (value_at(one.real, one.grid, x, y) > 0.5 for one in (shown, scene))
        assert real.any() and not real.all() and (real == expected).mean() > 0.95


def assert_same_ground(scene, levels):
    """Where a level is about as fine as the scene, their heights agree within a share of the spacing."""
    rng = np.random.default_rng(2)
    for level in levels:
        grid = level.grid
        shown = on_level(scene, grid, small_config().terrain.boulders)
        x, y = rng.uniform(-1, 1, (2, 10_000)) * grid.half_widths_m[0]
        x, y = x + grid.centre_x_m, y + grid.centre_y_m
        spacing = grid.spacing_under(x, y)
        close = spacing < 1.5 * scene.grid.spacing_under(x, y)
        assert close.sum() > 500
        error = (value_at(shown.height_m, grid, x, y) - value_at(scene.height_m, scene.grid, x, y)) / spacing
        assert abs(np.median(error[close])) < 0.01 and np.percentile(np.abs(error[close]), 95) < 0.1
        # Ground out of view is coarse, but its shadows reach into the view.
        x, y = rng.uniform(-1, 1, (2, 50_000)) * scene.grid.extent_m / 2
        error = value_at(shown.height_m, grid, x, y) - value_at(scene.height_m, scene.grid, x, y)
        assert np.percentile(np.abs(error) / grid.spacing_under(x, y), 99) < 0.2


def test_a_scene_does_not_depend_on_its_levels(scene):
    whole = grow_scene(small_config(max_vertices=12_000_000), view_envelope(SMALL, FLIGHT), 5)
    assert np.array_equal(whole.height_m, scene.height_m) and np.array_equal(whole.albedo, scene.albedo)
    for name in ("craters", "rims", "boulders"):
        for field in dataclasses.fields(getattr(scene, name)):
            one, other = (getattr(getattr(own, name), field.name) for own in (whole, scene))
            assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def test_a_level_shows_the_boulders_that_its_mesh_resolves(scene, levels):
    counts = []
    for level in levels:
        shown = on_level(scene, level.grid, small_config().terrain.boulders)
        local = shown.grid.spacing_under(shown.boulders.x_m, shown.boulders.y_m)
        assert (shown.boulders.diameter_m >= 0.7 * local).all() and len(shown.boulder_z_m) == len(shown.boulders)
        counts.append(len(shown.boulders))
    assert counts[0] > 0 and len(set(counts)) > 1


def test_the_level_of_a_frame_follows_from_the_cameras_height(levels):
    bounds = [level.highest_m for level in levels[:-1]]
    assert level_index(levels, 50.0) == 0 and level_index(levels, 5000.0) == len(bounds)
    for k, bound in enumerate(bounds):
        assert level_index(levels, np.nextafter(bound, 0)) == k and level_index(levels, bound) == k + 1


def test_a_cached_scene_keeps_its_view(tmp_path, monkeypatch, scene):
    monkeypatch.setenv("PERILUNE_CACHE", str(tmp_path))
    config = small_config()
    cache._write(tmp_path / f"{cache.scene_key(config, scene.view, 5)}.npz", scene)
    again = cache.cached_scene(config, scene.view, 5)
    assert again.view is scene.view and len(list(tmp_path.iterdir())) == 1
    assert np.array_equal(again.height_m, scene.height_m)
    assert cache.scene_key(small_config(max_vertices=12_000_000), scene.view, 5) == cache.scene_key(
        config, scene.view, 5
    )
