import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests.helpers.scenes import config_with, round_craters

from perilune_render.terrain.craters.population import ORIGINS, draw_craters
from perilune_render.terrain.craters.rims import measure_rims
from perilune_render.terrain.craters.stamp import stamp_craters
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.interpolation import value_at

GRID = Grid.even(200, 400)
WIDE = Grid.even(1000, 2000)
RINGED = Grid(100, 50 * np.geomspace(1, 4, 140))


def laid(rows, base=None, grid=GRID):
    """Ground, albedo, craters and what laying them did, for rows of (x, y, diameter, depth/diameter, wear K/R^2)."""
    craters = round_craters(rows)
    height = np.zeros(grid.n_vertices) if base is None else base.copy()
    albedo = np.ones(grid.n_vertices)
    done = stamp_craters(height, albedo, grid, craters, np.full(len(craters), 0.2))
    return height, albedo, craters, done


def test_a_fresh_crater_on_a_plain():
    height, albedo, craters, _ = laid([(20, -30, 80, 0.15, 0.001)])
    rims = measure_rims(height, GRID, craters)
    assert np.isclose(rims.depth_m[0] / 80, 0.15, rtol=0.08)
    assert np.allclose(rims.normal[0], [0, 0, 1], atol=1e-3)
    assert np.isclose(rims.z_m[0], 0.184 * 0.15 * 80, rtol=0.15)
    # The crest, where the ground is highest along a ray, lies on the label circle.
    r = np.linspace(20, 70, 1001)
    crest = r[np.argmax(value_at(height, GRID, 20 + r, np.full_like(r, -30.0)))]
    assert abs(crest / 40 - 1) < 0.02
    assert value_at(height, GRID, np.array([170.0]), np.array([150.0]))[0] == 0
    assert value_at(albedo, GRID, np.array([20.0]), np.array([-30.0]))[0] > 1.15


@pytest.mark.parametrize("profile", ["fassett_thomson", "pangu"])
@pytest.mark.parametrize("ratio", [0.1, 0.15, 0.2])
@pytest.mark.parametrize("wear", [0.001, 0.005, 0.02, 0.05])
def test_the_crest_lies_on_the_labels_circle_however_worn(profile, ratio, wear):
    """On a plain: highest points along 64 rays, a circle with free centre through them by least squares."""
    craters = round_craters([(12.3, -7.7, 120, ratio, wear)])
    height = np.zeros(GRID.n_vertices)
    stamp_craters(height, np.ones_like(height), GRID, craters, np.zeros(1), profile)
    angle = 2 * np.pi * np.arange(64) / 64
    r = np.linspace(40, 80, 401)
    x, y = 12.3 + r * np.cos(angle)[:, None], -7.7 + r * np.sin(angle)[:, None]
    crest = r[value_at(height, GRID, x, y).argmax(axis=1)]
    px, py = crest * np.cos(angle), crest * np.sin(angle)
    system = np.stack([2 * px, 2 * py, np.ones(64)], axis=1)
    a, b, rest = np.linalg.lstsq(system, px**2 + py**2, rcond=None)[0]
    assert np.sqrt(rest + a**2 + b**2) == pytest.approx(60, rel=0.015) and np.hypot(a, b) < 0.5


def test_a_younger_crater_removes_the_older_rim():
    alone, _, _, _ = laid([(40, 0, 60, 0.15, 0.001)])
    both, _, _, _ = laid([(0, 0, 80, 0.15, 0.001), (40, 0, 60, 0.15, 0.001)])

    def radius(height):
        r = np.linspace(-20, 20, 401)
        profile = value_at(height, GRID, 40 + r, np.zeros_like(r))
        slope = (profile[-1] - profile[0]) / (r[-1] - r[0])
        return (profile - slope * r).std()

    # Inside the younger crater the ground is its own bowl on a tilted plane: no crest of the older one at x = 40.
    inner = np.linspace(25, 55, 301)
    bumps = np.diff(value_at(both, GRID, inner, np.zeros_like(inner)), 2)
    bumps_alone = np.diff(value_at(alone, GRID, inner, np.zeros_like(inner)), 2)
    assert np.abs(bumps).max() < 1.5 * np.abs(bumps_alone).max()
    assert np.isclose(radius(both), radius(alone), rtol=0.15)


def test_order_decides_which_rim_survives():
    older_first, _, _, _ = laid([(0, 0, 80, 0.15, 0.001), (40, 0, 60, 0.15, 0.001)])
    younger_first, _, _, _ = laid([(40, 0, 60, 0.15, 0.001), (0, 0, 80, 0.15, 0.001)])
    crest = value_at(older_first, GRID, np.array([40.0]), np.array([0.0]))
    assert crest < value_at(younger_first, GRID, np.array([40.0]), np.array([0.0])) - 3


def test_a_worn_crater_is_shallow_and_leaves_no_ridge():
    height, _, craters, _ = laid([(0, 0, 100, 0.15, 0.2)])
    assert measure_rims(height, GRID, craters).depth_m[0] < 0.25 * 15
    assert np.abs(np.diff(height.reshape(801, 801)[400], 2)).max() < 0.002


def test_a_crater_on_a_slope_is_tilted_with_it():
    slope = 0.1 * GRID.vertices_xy()[0]
    height, _, craters, _ = laid([(0, 0, 60, 0.15, 0.001)], slope)
    normal = measure_rims(height, GRID, craters).normal[0]
    assert np.allclose(normal, np.array([-0.1, 0, 1]) / np.hypot(0.1, 1), atol=0.01)


def test_laying_is_repeatable_and_craters_at_the_edge_stay_inside():
    rows = [(195, 195, 60, 0.15, 0.01), (-200, 0, 40, 0.1, 0.01), (400, 400, 50, 0.1, 0.01)]
    first, second = laid(rows)[0], laid(rows)[0]
    assert np.array_equal(first, second) and np.isfinite(first).all() and first.min() < -3


def test_rings_hold_the_same_crater_as_an_even_grid():
    # Across the inner square's edge, over a ring's corner, and around a whole side.
    for x, y in ((50, 0), (70, -75), (-90, 20)):
        even, _, _, _ = laid([(x, y, 40, 0.15, 0.01)])
        ringed, _, _, _ = laid([(x, y, 40, 0.15, 0.01)], grid=RINGED)
        places = np.random.default_rng(1).uniform(-35, 35, (2, 4000)) + np.array([[x], [y]])
        error = value_at(ringed, RINGED, *places) - value_at(even, GRID, *places)
        assert np.abs(error).max() < 0.25 and np.sqrt(np.mean(error**2)) < 0.03


def test_population_is_oldest_first_and_differs_by_seed():
    config = config_with().terrain.craters
    craters = draw_craters(config, GRID, 4)
    assert (np.diff(craters.age_myr) <= 0).all()
    assert len(craters) > 500 and craters.diameter_m.min() >= config.min_diameter_spacings * 0.5 * 0.999
    again, other = draw_craters(config, GRID, 4), draw_craters(config, GRID, 5)
    assert np.array_equal(craters.x_m, again.x_m) and not np.array_equal(craters.x_m[:50], other.x_m[:50])
    assert draw_craters(config, GRID, 4, max_diameter_m=20).diameter_m.max() <= 20


def test_secondaries_lie_in_clusters_and_keep_the_law():
    config = config_with().terrain.craters.model_copy(update={"min_diameter_spacings": 8})
    none = draw_craters(config.model_copy(update={"secondary_share": 0.0}), WIDE, 4)
    some = draw_craters(config.model_copy(update={"secondary_share": 0.05}), WIDE, 4)
    assert np.array_equal(np.sort(none.diameter_m), np.sort(some.diameter_m))
    secondary = some.origin == ORIGINS.index("secondary")
    assert 0.02 < secondary.mean() < 0.05 and (none.origin == ORIGINS.index("primary")).all()

    def crowding(craters, which):
        places = np.column_stack([craters.x_m[which], craters.y_m[which]])
        # The nearest one is the crater itself.
        distance, _ = cKDTree(places).query(places, k=6)
        return np.median(distance[:, 5]) * np.sqrt(which.sum())

    assert crowding(some, secondary) < 0.75 * crowding(some, ~secondary)


def test_a_crater_under_a_younger_one_is_gone():
    # In order: under the second; beside it; half under it; the youngest one itself, smaller and inside.
    rows = [(0, 0, 30, 0.1, 0.001), (0, 5, 90, 0.1, 0.001), (100, 0, 30, 0.1, 0.001), (10, 0, 20, 0.1, 0.001)]
    assert laid(rows)[3].rim_left.tolist() == pytest.approx([0, 1, 1, 1], abs=0.02)
    assert 0.3 < laid([(45, 0, 30, 0.1, 0.001), (0, 0, 90, 0.1, 0.001)])[3].rim_left[0] < 0.7
    assert laid([(0, 0, 30, 0.1, 0.5), (0, 0, 90, 0.1, 0.4)])[3].rim_left[0] > 0.3


def test_a_worn_crater_on_a_bowls_floor_is_not_as_deep_as_the_bowl():
    height, _, craters, done = laid([(0, 0, 160, 0.2, 0.001), (0, 0, 50, 0.13, 0.1)])
    alone, _, small, _ = laid([(0, 0, 50, 0.13, 0.1)])
    own = measure_rims(alone, GRID, small).depth_m[0]
    assert done.sag_m[0] == pytest.approx(0, abs=1e-9) and done.sag_m[1] > 0.1
    plain, corrected = (measure_rims(height, GRID, craters, sag).depth_m[1] for sag in (0.0, done.sag_m))
    assert own < corrected < plain - 0.1 * own
