import dataclasses
import itertools
import re

import numpy as np
import pytest
from tests.helpers import elevation_models
from tests.helpers.scenes import config_with

from perilune_render.config import FlightConfig
from perilune_render.config_values import Span
from perilune_render.flight.trajectories import fly
from perilune_render.flight.view import view_envelope
from perilune_render.terrain import cache
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.grid import graded_grid
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.levels import cut_levels, finest_level
from perilune_render.terrain.scene import grow_scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera

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


def level_of(levels, z_m):
    return next(level for level in levels if z_m < level.highest_m)


def test_one_mesh_that_fits_is_the_only_level():
    terrain = config_with().terrain
    (level,) = cut_levels(terrain, VIEW)
    whole = graded_grid(terrain, VIEW)
    assert level.highest_m == np.inf and level.grid.n_half == whole.n_half
    assert np.array_equal(level.grid.half_widths_m, whole.half_widths_m)


@pytest.mark.parametrize(("size", "n_levels"), [(512, 10), (1024, 13)])
def test_a_larger_image_needs_levels_of_at_most_the_limit(size, n_levels):
    camera = Camera.from_field_of_view(size, size, 50.0)
    levels = cut_levels(config_with().terrain, view_envelope(camera, FLIGHT))
    assert len(levels) == n_levels
    assert all(level.grid.n_vertices <= 12_000_000 for level in levels)
    assert (np.diff([level.highest_m for level in levels]) > 0).all() and levels[-1].highest_m == np.inf
    extents = [level.grid.extent_m for level in levels]
    assert np.allclose(extents, graded_grid(config_with().terrain, view_envelope(camera, FLIGHT)).extent_m)


@pytest.mark.parametrize("azimuth", [Span(low=0, high=0), Span(low=30, high=140), Span(low=0, high=360)])
def test_every_frame_sees_half_a_pixel_or_finer_ground_on_its_level(azimuth):
    """The ground is flat here; the levels allow for ground that rises by a twentieth of the altitude."""
    flight = FlightConfig(azimuth_deg=azimuth)
    levels = cut_levels(config_with(terrain={"max_vertices": 1_500_000}).terrain, view_envelope(CAMERA, flight))
    assert len(levels) > 3
    edge = np.linspace(0, 256, 9)
    points = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(-1, 2)
    for seed in range(30):
        flown = fly(flight, 40, seed)
        rays = np.einsum("nji,kj->nki", flown.rotation_camera_from_site, CAMERA.rays(points))
        ground = flown.position_m[:, None] + rays * flown.position_m[:, None, 2:] / -rays[..., 2:]
        for position, place in zip(flown.position_m, ground, strict=True):
            grid = level_of(levels, position[2]).grid
            spacing = grid.spacing_under(place[:, 0], place[:, 1])
            assert spacing.max() <= 0.505 * position[2] / CAMERA.fx_px


@pytest.mark.parametrize("most", [50_000, 250_000, 800_000])
def test_too_many_vertices_for_any_level_are_refused_and_a_spacing_is_named_that_fits(most):
    with pytest.raises(UserError, match=r"dataset.terrain.spacing_px: got 0.5 needs 912,... vertices") as refusal:
        cut_levels(config_with(terrain={"max_vertices": most}).terrain, VIEW)
    named = float(re.search(r"at least ([0-9.]+),", refusal.value.expected)[1])
    wider = config_with(terrain={"max_vertices": most, "spacing_px": named})
    assert all(level.grid.n_vertices <= most for level in cut_levels(wider.terrain, VIEW))
    finer = config_with(terrain={"max_vertices": most, "spacing_px": round(named - 0.01, 2)})
    with pytest.raises(UserError, match="spacing_px"):
        cut_levels(finer.terrain, VIEW)


def test_a_mesh_that_no_spacing_makes_small_enough_names_none():
    own = dataclasses.replace(VIEW, seen=None)
    with pytest.raises(UserError, match=r"expected a larger dataset.terrain.max_vertices, fewer or wider pixels"):
        cut_levels(config_with(terrain={"max_vertices": 10_000}).terrain, own)


def test_a_users_own_view_allows_one_mesh_only():
    own = ViewEnvelope(VIEW.height_m, VIEW.reach_m, VIEW.focal_px)
    with pytest.raises(UserError, match=r"got 0.5 needs 4,...,... vertices"):
        cut_levels(config_with(terrain={"max_vertices": 1_500_000}).terrain, own)


def test_the_finest_grid_of_a_place_is_found():
    grids = [level.grid for level in cut_levels(config_with(terrain={"max_vertices": 1_500_000}).terrain, VIEW)]
    x, y = np.random.default_rng(1).uniform(-1300, 1300, (2, 500))
    index, spacing = finest_level(grids, x, y)
    every = np.array([grid.spacing_under(x, y) for grid in grids])
    assert np.array_equal(index, every.argmin(axis=0)) and np.array_equal(spacing, every.min(axis=0))
    assert len(set(index)) == len(grids)


def assert_same_ground(scene):
    """Where two neighbouring levels are about equally fine, their heights agree within a share of their spacing."""
    levels = [(level.grid, level.height_m) for level in scene.finer] + [(scene.grid, scene.height_m)]
    rng = np.random.default_rng(2)
    for (fine, height), (coarse, coarse_height) in itertools.pairwise(levels):
        x, y = rng.uniform(-1, 1, (2, 10_000)) * coarse.half_widths_m[0]
        x, y = x + coarse.centre_x_m, y + coarse.centre_y_m
        spacing = np.maximum(fine.spacing_under(x, y), coarse.spacing_under(x, y))
        close = spacing < 1.2 * coarse.spacings_m.min()
        assert close.sum() > 1000
        error = (value_at(height, fine, x, y) - value_at(coarse_height, coarse, x, y))[close] / spacing[close]
        assert abs(np.median(error)) < 0.01 and np.percentile(np.abs(error), 95) < 0.1
        # Ground out of view is coarse, but its shadows reach into the view: it has no spikes.
        x, y = rng.uniform(-1, 1, (2, 200_000)) * coarse.extent_m / 2
        assert np.abs(value_at(height, fine, x, y) - value_at(coarse_height, coarse, x, y)).max() < 12
    assert value_at(levels[0][1], levels[0][0], 0.0, 0.0) == pytest.approx(0, abs=1e-6)


def test_all_levels_show_the_same_ground(scene):
    assert len(scene.finer) >= 3
    assert_same_ground(scene)


@pytest.mark.parametrize("outside", ["procedural", "mirror"])
def test_all_levels_show_the_same_ground_of_an_elevation_model(tmp_path, outside):
    """The model covers a part of the ground in view."""
    dem = elevation_models.write(
        tmp_path / "model.tif", elevation_models.rough(n=200), elevation_models.POLAR, elevation_models.PLACED
    )
    config = small_config(dem=str(dem), elevation={"outside": outside}, max_vertices=400_000)
    scene = grow_scene(config, view_envelope(SMALL, config.detect.flight), 5)
    assert scene.finer and scene.real.any() and not scene.real.all()
    assert_same_ground(scene)


def test_craters_do_not_depend_on_the_levels(scene):
    """Compared with the same ground as one mesh: the same craters, but for the smallest ones and ground out of view."""
    config = small_config(max_vertices=12_000_000)
    whole = grow_scene(config, view_envelope(SMALL, config.detect.flight), 5)
    assert not whole.finer
    one = {(x, y): k for k, (x, y) in enumerate(zip(whole.craters.x_m, whole.craters.y_m, strict=True))}
    pairs = [(k, one.get((x, y))) for k, (x, y) in enumerate(zip(scene.craters.x_m, scene.craters.y_m, strict=True))]
    known = np.array([pair for pair in pairs if pair[1] is not None])
    # A crater whose rim is nearly erased may be counted on one ground and not on the other.
    assert len(known) > 0.97 * len(scene.craters)
    ours, theirs = known.T
    diameter = scene.craters.diameter_m[ours]
    assert np.array_equal(diameter, whole.craters.diameter_m[theirs])
    assert (np.diff(theirs) > 0).all()
    _, spacing = finest_level([level.grid for level in (*scene.finer, scene)], *np.zeros((2, 1)))
    assert scene.craters.diameter_m.min() >= 2.2 * spacing[0]
    large = diameter > 6 * whole.grid.spacing_under(scene.craters.x_m[ours], scene.craters.y_m[ours])
    assert large.sum() > 500
    error = (scene.rims.z_m[ours] - whole.rims.z_m[theirs])[large] / diameter[large]
    assert np.median(np.abs(error)) < 0.005 and np.percentile(np.abs(error), 99) < 0.05
    depth = (scene.rims.depth_m[ours] - whole.rims.depth_m[theirs])[large] / diameter[large]
    assert np.median(np.abs(depth)) < 0.005
    assert np.median(np.abs(scene.rims.normal[ours] - whole.rims.normal[theirs])[large]) < 0.01


def test_a_level_has_the_boulders_that_are_large_enough_for_it(scene):
    config = small_config()
    shown = [scene.at_level(k, config.terrain.boulders) for k in range(len(scene.finer) + 1)]
    counts = [len(level.boulders) for level in shown]
    assert counts[0] > 0 and len(set(counts)) > 1
    for level in shown:
        local = level.grid.spacing_under(level.boulders.x_m, level.boulders.y_m)
        assert (level.boulders.diameter_m >= 0.7 * local).all() and len(level.boulder_z_m) == len(level.boulders)


def test_the_level_of_a_frame_follows_from_the_cameras_height(scene):
    bounds = [level.highest_m for level in scene.finer]
    assert scene.level_index(50.0) == 0 and scene.level_index(5000.0) == len(bounds)
    for k, bound in enumerate(bounds):
        assert scene.level_index(np.nextafter(bound, 0)) == k and scene.level_index(bound) == k + 1


def test_levels_are_cached(tmp_path, monkeypatch, scene):
    monkeypatch.setenv("PERILUNE_CACHE", str(tmp_path))
    config = small_config()
    view = view_envelope(SMALL, config.detect.flight)
    cache._write(tmp_path / f"{cache.scene_key(config, view, 5)}.npz", scene)
    again = cache.cached_scene(config, view, 5)
    assert len(again.finer) == len(scene.finer) and len(list(tmp_path.iterdir())) == 1
    for one, other in zip(again.finer, scene.finer, strict=True):
        assert one.highest_m == other.highest_m and one.grid.centre_y_m == other.grid.centre_y_m
        assert np.array_equal(one.height_m, other.height_m) and np.array_equal(one.albedo, other.albedo)
    assert cache.scene_key(small_config(max_vertices=12_000_000), view, 5) != cache.scene_key(config, view, 5)
