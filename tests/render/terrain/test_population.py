"""Populations and finished ground, regenerated and measured: do they have the statistics that were asked for?"""

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import DatasetConfig, FlightConfig
from perilune_render.config.terrain import CratersConfig
from perilune_render.config.values import Span
from perilune_render.flight.view import view_envelope
from perilune_render.terrain.craters.population import ORIGINS, draw_craters
from perilune_render.terrain.craters.profile import REACH, crest_radius, profile_tables, wear_row
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import Scene, grow_scene
from perilune_render.terrain.size_frequency import EQUILIBRIA, Minimum, NeukumProduction
from perilune_shared.config.resolve import resolve
from perilune_shared.geometry.camera import Camera

EVEN = Grid.even(1500, 1500)


@pytest.fixture(scope="module")
def scene() -> Scene:
    config = config_with()
    return grow_scene(config, view_envelope(Camera.from_field_of_view(256, 256, 50.0), FlightConfig()), 7)


@pytest.mark.parametrize("law", sorted(EQUILIBRIA))
def test_the_size_frequency_asked_for(law):
    config = CratersConfig(equilibrium=law, equilibrium_share=Span(low=1.3, high=1.3), min_diameter_spacings=8)
    craters = draw_craters(config, EVEN, 5)
    population_law = Minimum(NeukumProduction(age_gyr=3.5), EQUILIBRIA[law](share=1.3))
    edges = np.array([8.0, 12, 18, 30, 50, 90, 200, 799])
    expected = -np.diff(population_law.csfd(edges)) * 3000.0**2
    found = np.histogram(craters.diameter_m, edges)[0]
    assert (np.abs(found - expected) < 4 * np.sqrt(expected) + 1).all() and expected[0] > 1000


def test_primaries_lie_at_random():
    craters = draw_craters(CratersConfig(min_diameter_spacings=8, secondary_share=0.0), EVEN, 6)
    # Counts in squares of 100 m: for a Poisson process the variance is the mean, here to within four of its errors.
    counts = np.histogram2d(craters.x_m, craters.y_m, bins=30, range=[[-1500, 1500]] * 2)[0].ravel()
    assert counts.mean() > 4
    assert abs(counts.var(ddof=1) / counts.mean() - 1) < 4 * np.sqrt(2 / (len(counts) - 1))
    # And nearest neighbours are as far as at random: 1 / (2 sqrt(density)), Clark and Evans.
    inside = np.maximum(np.abs(craters.x_m), np.abs(craters.y_m)) < 600
    distance = np.hypot(craters.x_m[inside, None] - craters.x_m, craters.y_m[inside, None] - craters.y_m)
    nearest = np.partition(distance, 1, axis=1)[:, 1]
    assert nearest.mean() * 2 * np.sqrt(len(craters) / 9e6) == pytest.approx(1, abs=0.05)


def settled(scene, spacings, spared):
    """Craters wide enough to be measured, away from the edge, whose rim stands alone.

    No younger crater of `spared` their size took any of it, and no older one that is still clear has its own rim there.
    """
    c = scene.craters
    distance = np.maximum(np.abs(c.x_m), np.abs(c.y_m))
    wide = c.diameter_m > spacings * scene.grid.spacing_at(distance + c.diameter_m)
    wide &= (distance + c.diameter_m < scene.grid.extent_m / 2) & (c.origin == ORIGINS.index("primary"))
    # Only craters above `least` times a crater's size can disturb it: look at those alone, smallest first.
    order, least = np.argsort(c.diameter_m), min(0.4, spared)
    x, y, diameter, wear_m2 = c.x_m[order], c.y_m[order], c.diameter_m[order], c.wear_m2[order]
    for k in np.flatnonzero(wide):
        rest = slice(np.searchsorted(diameter, least * c.diameter_m[k]), None)
        younger = order[rest] > k
        apart = np.hypot(x[rest] - c.x_m[k], y[rest] - c.y_m[k])
        own, other = c.diameter_m[k] / 2, diameter[rest] / 2
        near = np.abs(apart - own) < 1.6 * other
        clear = wear_m2[rest] < 0.06 * other**2
        older = ~younger & clear & (np.abs(apart - own) < 1.25 * other) & (other > 0.4 * own) & (apart > 0)
        wide[k] = not (older | (younger & near & (other > spared * own))).any()
    return np.flatnonzero(wide)


@pytest.mark.slow
def test_depth_against_freshness(scene):
    """Depth left on the finished ground against wear, beside the published fit (1 + K/(a R^2))^-p."""
    c = scene.craters
    chosen = settled(scene, 10, 0.3)
    radius = c.diameter_m[chosen] / 2
    wear = c.wear_m2[chosen] / radius**2
    left = scene.rims.depth_m[chosen] / c.fresh_depth_m[chosen]
    a, p = 0.1151 + 0.01708 * np.log(2 * radius), 2.070 + 0.0921 * np.log(2 * radius)
    published = (1 + wear / a) ** -p
    for low, high in ((0, 0.01), (0.01, 0.03), (0.03, 0.07), (0.07, 0.15)):
        which = (wear >= low) & (wear < high)
        assert which.sum() > 8
        assert np.median(left[which]) == pytest.approx(np.median(published[which]), abs=0.13)
    assert np.corrcoef(left, published)[0, 1] > 0.9


def fitted_radius(scene, k):
    """Radius over the label's of the circle fitted to a crater's rim on the finished ground.

    The rim's own profile, free in radius and height, is fitted beside a straight line for the older ground to the
    median of 64 rays from 0.8 to 1.2 radii.
    """
    c = scene.craters
    angle = 2 * np.pi * (np.arange(64) + 0.5) / 64
    x = np.linspace(0.8, 1.2, 151)
    dx, dy = (x[None, :] * part[:, None] * c.diameter_m[k] / 2 for part in (np.cos(angle), np.sin(angle)))
    height = value_at(scene.height_m, scene.grid, c.x_m[k] + dx, c.y_m[k] + dy)
    median = np.median(height - height.mean(axis=1, keepdims=True), axis=0)
    tables = profile_tables()
    wear = c.wear_m2[k : k + 1] / (c.diameter_m[k] / 2) ** 2
    row = round(float(wear_row(wear)[0]))
    bowl = tables.flat_bowl if c.flat_floor[k] else tables.bowl
    shape = c.rim_height_m[k] * tables.rim[row] + c.fresh_depth_m[k] * bowl[row]
    crest = crest_radius(wear, c.fresh_depth_m[k : k + 1] / c.rim_height_m[k : k + 1])[0]
    profile = CubicSpline(np.linspace(0, REACH, len(shape)) / crest, shape)
    trial = np.linspace(0.9, 1.1, 201)
    left = [
        np.linalg.lstsq(np.stack([profile(x / radius), np.ones_like(x), x], axis=1), median, rcond=None)[1][0]
        for radius in trial
    ]
    return trial[np.argmin(left)]


@pytest.mark.slow
def test_a_circle_fitted_to_every_fresh_crater_is_its_label():
    config = config_with()
    fits = []
    # The first four seeds have 13; with other ground, more scenes are generated.
    for seed in (8, 12, 16, 18, *range(19, 31)):
        if len(fits) >= 12:
            break
        scene = grow_scene(config, view_envelope(Camera.from_field_of_view(192, 192, 50.0), FlightConfig()), seed)
        c = scene.craters
        fresh = [k for k in settled(scene, 24, 0.1) if c.wear_m2[k] < 0.008 * (c.diameter_m[k] / 2) ** 2]
        fits += [fitted_radius(scene, k) for k in fresh]
    assert len(fits) >= 10
    assert np.abs(np.array(fits) - 1).max() < 0.02 and np.mean(fits) == pytest.approx(1, abs=0.004)


def grown(region):
    """The scene of seed 7 with the settings of configs/<region>.yaml, one vertex a pixel."""
    file = Path(__file__).parents[3] / "configs" / f"{region}.yaml"
    config = resolve(DatasetConfig, "dataset", "perilune_render", "small", file, ("dataset.terrain.spacing_px=1.0",))
    return grow_scene(config, view_envelope(Camera.from_field_of_view(192, 192, 50.0), FlightConfig()), 7)


def rises(scene, baseline_m, n=40_000):
    """Differences of height over a baseline at random places, as altimeters measure them."""
    x, y = np.random.default_rng(1).uniform(-1000, 1000, (2, n))
    return value_at(scene.height_m, scene.grid, x + baseline_m, y) - value_at(scene.height_m, scene.grid, x, y)


def test_finished_ground_has_the_slopes_and_the_hurst_exponent_asked_for():
    """Craters and relief together. Published for baselines of metres to tens of metres: H 0.7 to 0.95."""
    median = {}
    for region in ("mare", "highland"):
        scene = grown(region)
        deviation = [np.median(np.abs(rises(scene, lag))) for lag in (6, 12, 24, 48)]
        hurst = np.polyfit(np.log([6, 12, 24, 48]), np.log(deviation), 1)[0]
        assert 0.65 < hurst < 0.97
        median[region] = np.degrees(np.arctan(deviation[1] / 12))
    # The relief alone goes as 1 to 2.4; craters, alike on both, bring the whole nearer together.
    assert 0.5 < median["mare"] < 3 and 1.4 < median["highland"] / median["mare"] < 2.6


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_no_vertex_stands_up_as_a_spike(seed):
    """Nothing is steeper than craters on craters make it; a spike would throw a line of shadow across the frames."""
    config = config_with(terrain={"relief": {"rms_slope_deg": 3.0}})
    scene = grow_scene(config, view_envelope(Camera.from_field_of_view(160, 160, 50.0), FlightConfig()), seed)
    faces, height = scene.grid.quads(), scene.height_m.astype(float)
    x, y = scene.grid.vertices_xy()
    for a, b in ((0, 1), (1, 2)):
        run = np.hypot(x[faces[:, a]] - x[faces[:, b]], y[faces[:, a]] - y[faces[:, b]])
        slope = np.abs(height[faces[:, a]] - height[faces[:, b]]) / run
        assert slope.max() < 2.5 and (slope > 1).mean() < 2e-5
