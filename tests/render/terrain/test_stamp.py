import numpy as np
import pytest

from perilune_render.terrain.craters import Craters, draw_craters
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.measure import height_at, measure_rims
from perilune_render.terrain.stamp import rim_left, stamp_craters
from tests.render.conftest import config_with

GRID = Grid(np.linspace(-200, 200, 801))


def laid(rows, base=None):
    """Ground after laying craters given as (x, y, diameter, depth/diameter, wear K/R^2)."""
    x, y, diameter, ratio, wear = np.array(rows, float).T
    craters = Craters(x, y, diameter, ratio * diameter, np.zeros_like(x), wear * (diameter / 2) ** 2)
    height = np.zeros((801, 801)) if base is None else base.copy()
    albedo = np.ones((801, 801))
    stamp_craters(height, albedo, GRID, craters, np.full(len(x), 0.2))
    return height, albedo, craters


def test_a_fresh_crater_on_a_plain():
    height, albedo, craters = laid([(20, -30, 80, 0.15, 0.001)])
    rims = measure_rims(height, GRID, craters)
    assert np.isclose(rims.depth_m[0] / 80, 0.15, rtol=0.08)
    assert np.allclose(rims.normal[0], [0, 0, 1], atol=1e-3)
    assert np.isclose(rims.z_m[0], 0.0368 * 80, rtol=0.15)
    # The crest, where the ground is highest along a ray, lies on the label circle.
    r = np.linspace(20, 70, 1001)
    crest = r[np.argmax(height_at(height, GRID, 20 + r, np.full_like(r, -30.0)))]
    assert abs(crest / 40 - 1) < 0.02
    assert height_at(height, GRID, np.array([170.0]), np.array([150.0]))[0] == 0
    assert height_at(albedo, GRID, np.array([20.0]), np.array([-30.0]))[0] > 1.15


def test_a_younger_crater_removes_the_older_rim():
    alone, _, _ = laid([(40, 0, 60, 0.15, 0.001)])
    both, _, _ = laid([(0, 0, 80, 0.15, 0.001), (40, 0, 60, 0.15, 0.001)])

    def radius(height):
        r = np.linspace(-20, 20, 401)
        profile = height_at(height, GRID, 40 + r, np.zeros_like(r))
        slope = (profile[-1] - profile[0]) / (r[-1] - r[0])
        return (profile - slope * r).std()

    # Inside the younger crater the ground is its own bowl on a tilted plane: no crest of the older one at x = 40.
    inner = np.linspace(25, 55, 301)
    bumps = np.diff(height_at(both, GRID, inner, np.zeros_like(inner)), 2)
    bumps_alone = np.diff(height_at(alone, GRID, inner, np.zeros_like(inner)), 2)
    assert np.abs(bumps).max() < 1.5 * np.abs(bumps_alone).max()
    assert np.isclose(radius(both), radius(alone), rtol=0.15)


def test_order_decides_which_rim_survives():
    older_first, _, _ = laid([(0, 0, 80, 0.15, 0.001), (40, 0, 60, 0.15, 0.001)])
    younger_first, _, _ = laid([(40, 0, 60, 0.15, 0.001), (0, 0, 80, 0.15, 0.001)])
    crest = height_at(older_first, GRID, np.array([40.0]), np.array([0.0]))
    assert crest < height_at(younger_first, GRID, np.array([40.0]), np.array([0.0])) - 3


def test_a_worn_crater_is_shallow_and_leaves_no_ridge():
    height, _, craters = laid([(0, 0, 100, 0.15, 0.2)])
    assert measure_rims(height, GRID, craters).depth_m[0] < 0.25 * 15
    assert np.abs(np.diff(height[400], 2)).max() < 0.002


def test_a_crater_on_a_slope_is_tilted_with_it():
    slope = np.tile(0.1 * GRID.coordinates_m, (801, 1))
    height, _, craters = laid([(0, 0, 60, 0.15, 0.001)], slope)
    normal = measure_rims(height, GRID, craters).normal[0]
    assert np.allclose(normal, np.array([-0.1, 0, 1]) / np.hypot(0.1, 1), atol=0.01)


def test_laying_is_repeatable_and_craters_at_the_edge_stay_inside():
    rows = [(195, 195, 60, 0.15, 0.01), (-200, 0, 40, 0.1, 0.01), (400, 400, 50, 0.1, 0.01)]
    first, second = laid(rows)[0], laid(rows)[0]
    assert np.array_equal(first, second) and np.isfinite(first).all() and first.min() < -3


def test_population_is_ordered_by_wear_and_differs_by_seed():
    config = config_with().terrain.craters
    craters = draw_craters(config, GRID, 4)
    assert (np.diff(craters.wear_m2) <= 0).all()
    assert len(craters) > 500 and craters.diameter_m.min() >= 3 * 0.5 * 0.999
    again, other = draw_craters(config, GRID, 4), draw_craters(config, GRID, 5)
    assert np.array_equal(craters.x_m, again.x_m) and not np.array_equal(craters.x_m[:50], other.x_m[:50])
    assert draw_craters(config, GRID, 4, max_diameter_m=20).diameter_m.max() <= 20


def test_a_crater_under_a_younger_one_is_gone():
    # In order: under the second; beside it; half under it; the youngest one itself, smaller and inside.
    _, _, craters = laid(
        [(0, 0, 30, 0.1, 0.001), (0, 5, 90, 0.1, 0.001), (100, 0, 30, 0.1, 0.001), (10, 0, 20, 0.1, 0.001)]
    )
    assert rim_left(craters).tolist() == pytest.approx([0, 1, 1, 1], abs=0.02)
    _, _, half = laid([(45, 0, 30, 0.1, 0.001), (0, 0, 90, 0.1, 0.001)])
    assert 0.4 < rim_left(half)[0] < 0.7
    _, _, worn = laid([(0, 0, 30, 0.1, 0.5), (0, 0, 90, 0.1, 0.4)])
    assert rim_left(worn)[0] > 0.3


def test_a_worn_crater_on_a_bowls_floor_is_not_as_deep_as_the_bowl():
    rows = np.array([(0, 0, 160, 0.2, 0.001), (0, 0, 50, 0.13, 0.2)], float)
    x, y, diameter, ratio, wear = rows.T
    craters = Craters(x, y, diameter, ratio * diameter, np.zeros(2), wear * (diameter / 2) ** 2)
    height = np.zeros((801, 801))
    sag = stamp_craters(height, np.ones_like(height), GRID, craters, np.zeros(2))
    alone, _, small = laid([(0, 0, 50, 0.13, 0.2)])
    own = measure_rims(alone, GRID, small).depth_m[0]
    assert sag[0] == pytest.approx(0, abs=1e-9) and sag[1] > 0.5
    assert measure_rims(height, GRID, craters).depth_m[1] > 1.5 * own
    assert measure_rims(height, GRID, craters, sag).depth_m[1] == pytest.approx(own, rel=0.5)
