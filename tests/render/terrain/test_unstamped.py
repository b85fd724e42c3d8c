"""Scenes without some craters, from recorded changes: equal to scenes that are generated without them."""

import numpy as np
import pytest
from tests.helpers.scenes import config_with

from perilune_render.config.derived import CounterfactualConfig
from perilune_render.config.terrain import TerrainConfig
from perilune_render.flight.view import view_envelope
from perilune_render.terrain.craters.removal import near
from perilune_render.terrain.scene import grow_scene
from perilune_render.terrain.unstamped import Unstamped
from perilune_shared.errors import UserError

SEED = 8
CONFIG = config_with(terrain=TerrainConfig(spacing_px=1.0))


@pytest.fixture(scope="module")
def view(camera):
    return view_envelope(camera, CONFIG.detect.flight)


@pytest.fixture(scope="module")
def whole(view):
    return grow_scene(CONFIG, view, SEED)


def chosen(scene):
    """Ids of the deepest craters, some of the oldest and some with rays."""
    deepest = np.argsort(-scene.rims.depth_m)[:3]
    wear = scene.craters.wear_m2 / (scene.craters.diameter_m / 2) ** 2
    return np.unique([*deepest, *range(3), *np.argsort(np.where(scene.craters.diameter_m > 10, wear, 1))[:3]])


@pytest.fixture(scope="module")
def unstamped(whole, view):
    return Unstamped(whole, CONFIG, view, chosen(whole))


def grown(view, ids):
    removed = CounterfactualConfig(removed={SEED: tuple(map(int, ids))})
    return grow_scene(CONFIG.model_copy(update={"counterfactual": removed}), view, SEED)


def test_it_equals_the_scene_that_is_generated_without_the_craters(whole, view, unstamped):
    ids = chosen(whole)
    made, expected = unstamped.without(ids), grown(view, ids)
    close = near(*whole.grid.vertices_xy(), whole.craters.chosen(ids))
    assert (made.height_m != whole.height_m).mean() > 0.001
    # Heights are rounded to float32. Beyond the removed craters `grow_scene` neglects changes of centimetres.
    np.testing.assert_allclose(made.height_m[close], expected.height_m[close], rtol=0, atol=1e-4)
    np.testing.assert_allclose(made.height_m, expected.height_m, rtol=0, atol=0.05)
    np.testing.assert_allclose(made.albedo, expected.albedo, rtol=0, atol=1e-5)
    for name in ("x_m", "y_m", "diameter_m"):
        assert np.array_equal(getattr(made.boulders, name), getattr(expected.boulders, name))
    np.testing.assert_allclose(made.boulder_z_m, expected.boulder_z_m, rtol=0, atol=0.05)
    assert not np.array_equal(made.albedo, whole.albedo)


def test_each_call_starts_from_the_whole_scene(whole, unstamped):
    first, *others = chosen(whole)
    alone = unstamped.without([first])
    unstamped.without(others)
    again = unstamped.without([first])
    assert np.array_equal(alone.height_m, again.height_m)
    assert np.array_equal(alone.albedo, again.albedo)


def test_without_removals_nothing_changes(whole, unstamped):
    same = unstamped.without([])
    assert np.array_equal(same.height_m, whole.height_m)
    np.testing.assert_allclose(same.albedo, whole.albedo, rtol=0, atol=1e-6)


@pytest.mark.parametrize("crater_id", [-1, 10**6])
def test_an_unknown_crater_is_refused(whole, view, crater_id):
    with pytest.raises(UserError, match=f"crater_id: got {crater_id}"):
        Unstamped(whole, CONFIG, view, [crater_id])
