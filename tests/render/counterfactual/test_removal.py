"""Scenes without some of their craters: nothing else changes."""

import dataclasses

import numpy as np
import pytest
from tests.helpers.scenes import config_with, round_craters

from perilune_render.config.derived import CounterfactualConfig
from perilune_render.config.terrain import BouldersConfig, TerrainConfig
from perilune_render.flight.view import view_envelope
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.terrain.boulders import draw_boulders
from perilune_render.terrain.cache import cached_scene, scene_key
from perilune_render.terrain.craters.removal import REACH_RADII, indices_of, near
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.scene import grow_scene
from perilune_shared.errors import UserError

SEED = 8
CONFIG = config_with(terrain=TerrainConfig(spacing_px=1.0))
GRID = Grid.even(500, 1000)


@pytest.fixture(scope="module")
def view(camera):
    return view_envelope(camera, CONFIG.detect.flight)


@pytest.fixture(scope="module")
def whole(view):
    return grow_scene(CONFIG, view, SEED)


def without(crater_ids, seed=SEED):
    return CONFIG.model_copy(update={"counterfactual": CounterfactualConfig(removed={seed: tuple(crater_ids)})})


def fresh(scene, n):
    """Ids of the deepest of the larger craters, relative to their size."""
    ratio = np.where(scene.craters.diameter_m > 20, scene.rims.depth_m / scene.craters.diameter_m, 0)
    return np.argsort(-ratio)[:n]


def radii_from(scene, crater_id):
    """Distance of each vertex from a crater, crater radii."""
    x, y = scene.grid.vertices_xy()
    craters = scene.craters
    return np.hypot(x - craters.x_m[crater_id], y - craters.y_m[crater_id]) / (craters.diameter_m[crater_id] / 2)


def test_heights_change_within_reach_and_nowhere_else(whole, view):
    ids = sorted(fresh(whole, 3).tolist())
    changed = grow_scene(without(ids), view, SEED)
    inside = np.min([radii_from(whole, k) for k in ids], axis=0) <= REACH_RADII
    assert 0 < inside.mean() < 0.5
    assert np.array_equal(changed.height_m[~inside], whole.height_m[~inside])
    for k in ids:
        centre = radii_from(whole, k) < 0.2
        raised = (changed.height_m - whole.height_m)[centre].mean()
        # The floor of a fresh crater lies below the plain by its depth less the height of its rim, a fifth of it.
        assert 0.6 * whole.rims.depth_m[k] < raised < 1.1 * whole.rims.depth_m[k]


def test_other_craters_keep_ids_and_far_ones_their_rims(whole, view):
    ids = sorted(fresh(whole, 2).tolist())
    changed = grow_scene(without(ids), view, SEED)
    assert sorted([*changed.crater_id, *ids]) == list(range(len(whole.craters)))
    assert changed.removed.tolist() == ids
    assert np.array_equal(changed.craters.x_m, whole.craters.x_m[changed.crater_id])
    circles = RimCircles.of_scene(changed)
    assert np.array_equal(circles.crater_id, changed.crater_id)
    # A rim samples heights up to one radius and one vertex from its centre.
    distance = np.min(
        [
            np.hypot(changed.craters.x_m - whole.craters.x_m[k], changed.craters.y_m - whole.craters.y_m[k])
            - REACH_RADII * whole.craters.diameter_m[k] / 2
            for k in ids
        ],
        axis=0,
    )
    far = distance > changed.craters.diameter_m / 2 + 2 * whole.grid.spacings_m.max()
    assert 0.3 < far.mean() < 1
    for field in dataclasses.fields(changed.rims):
        before, after = (getattr(scene.rims, field.name) for scene in (whole, changed))
        assert np.array_equal(after[far], before[changed.crater_id][far])


def boulder_rows(boulders):
    columns = (boulders.x_m, boulders.y_m, boulders.diameter_m, boulders.shape_id, *boulders.rotation_wxyz.T)
    return list(zip(*(column.tolist() for column in columns), strict=True))


def test_boulders_of_a_removed_crater_go_and_the_others_stay():
    craters = round_craters([(-300, 0, 100, 0.2), (300, 0, 100, 0.2), (0, 300, 40, 0.2)])
    config = BouldersConfig(density=0.01, field_density=1000.0)
    before, after = (boulder_rows(draw_boulders(config, GRID, craters, 2, removed)) for removed in ((), (1,)))
    left = set(after)
    assert [row for row in before if row in left] == after
    gone = np.array([row for row in before if row not in left])
    distance = np.hypot(gone[:, 0] - 300, gone[:, 1])
    assert len(gone) > 500
    # None lies within the rim, and a density of exp(-(x - 1) / 0.7) has its mean at x = 1.988.
    assert distance.min() >= 50
    assert distance.mean() / 50 == pytest.approx(1 + 0.7 * (1 + 2 * 0.7) / 1.7, rel=0.1)
    plain = draw_boulders(config, GRID, craters, 2, (0, 1, 2))
    assert len(plain) == len(draw_boulders(config, GRID, craters.chosen([]), 2))


def test_scenes_without_a_crater_keep_the_boulders_of_others(whole, view):
    ids = fresh(whole, 20)
    changed = grow_scene(without(ids.tolist()), view, SEED)
    before, after = boulder_rows(whole.boulders), boulder_rows(changed.boulders)
    assert 0 < len(after) < len(before)
    left = set(after)
    assert [row for row in before if row in left] == after


def test_albedo_of_a_rayed_crater_goes_and_the_rest_stays(whole, view):
    craters = whole.craters
    wear = craters.wear_m2 / (craters.diameter_m / 2) ** 2
    able = (wear < 0.004) & (craters.origin == 0)
    crater_id = int(np.argmax(np.where(able, craters.diameter_m, 0)))
    changed = grow_scene(without([crater_id]), view, SEED)
    radii = radii_from(whole, crater_id)
    darker = changed.albedo < whole.albedo
    assert darker[radii < 0.9].mean() > 0.9
    assert darker[(radii > 3.1) & (radii < 9)].any()
    assert np.array_equal(changed.albedo[radii > 9.01], whole.albedo[radii > 9.01])
    assert not (changed.albedo > whole.albedo).any()


def test_the_zero_of_heights_stays_if_a_crater_at_the_site_is_removed(whole, view):
    craters = whole.craters
    at_site = np.flatnonzero(np.hypot(craters.x_m, craters.y_m) < craters.diameter_m / 2)
    crater_id = int(at_site[np.argmax(whole.rims.depth_m[at_site])])
    changed = grow_scene(without([crater_id]), view, SEED)
    far = radii_from(whole, crater_id) > REACH_RADII
    assert np.array_equal(changed.height_m[far], whole.height_m[far])
    assert abs(changed.height_m[np.argmin(np.hypot(*whole.grid.vertices_xy()))]) > 1e-3


def test_another_scene_is_not_changed(whole, view):
    assert np.array_equal(grow_scene(without([1], seed=SEED + 1), view, SEED).height_m, whole.height_m)


def test_the_cache_holds_both_scenes(whole, view, tmp_path, monkeypatch):
    monkeypatch.setenv("PERILUNE_CACHE", str(tmp_path))
    keys = {scene_key(config, view, SEED) for config in (CONFIG, without([3]), without([4]), without([3, 4]))}
    assert len(keys) == 4
    assert scene_key(without([3], seed=SEED + 1), view, SEED) == scene_key(CONFIG, view, SEED)
    first = cached_scene(without([3]), view, SEED)
    read = cached_scene(without([3]), view, SEED)
    assert len(cached_scene(CONFIG, view, SEED).craters) == len(first.craters) + 1 == len(whole.craters)
    assert read.removed.tolist() == first.removed.tolist() == [3]
    assert np.array_equal(read.crater_id, first.crater_id)


def test_craters_that_cannot_be_removed():
    assert indices_of((7, 5, 7), 5, 8, 1).tolist() == [5, 7]
    for crater_id in (4, 8):
        with pytest.raises(UserError, match="generated craters of the scene with seed 1, 5 to 7"):
            indices_of((crater_id,), 5, 8, 1)


def test_a_place_is_near_up_to_four_radii():
    removed = round_craters([[10.0, 0.0, 5.0, 0.2], [-100.0, 0.0, 2.0, 0.2]])
    x = np.array([10.0, 19.9, 20.1, -95.9, -96.1])
    assert near(x, np.zeros(5), removed).tolist() == [True, True, False, False, True]


def test_shallower_craters_stay_with_half_of_the_changed_heights(whole, view):
    ids = sorted(fresh(whole, 3).tolist())
    gone = grow_scene(without(ids), view, SEED)
    half = CounterfactualConfig(removed={SEED: tuple(ids)}, depth_share=0.5)
    config = CONFIG.model_copy(update={"counterfactual": half})
    changed = grow_scene(config, view, SEED)
    np.testing.assert_allclose(changed.height_m, (whole.height_m + gone.height_m) / 2, atol=1e-4)
    assert len(changed.removed) == 0 and np.array_equal(changed.crater_id, whole.crater_id)
    # The rims are measured again. Other craters in or around the crater keep their depth.
    ratio = changed.rims.depth_m[ids] / whole.rims.depth_m[ids]
    assert (ratio > 0.35).all() and (ratio < 0.65).all()
    assert np.array_equal(changed.albedo, whole.albedo)
    assert boulder_rows(changed.boulders) == boulder_rows(whole.boulders)
    keys = {scene_key(one, view, SEED) for one in (CONFIG, without(ids), config)}
    assert len(keys) == 3
