"""Populations and finished ground, regenerated and measured: do they have the statistics that were asked for?"""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from perilune_render.config import CratersConfig, FlightConfig, Span
from perilune_render.terrain.craters import ORIGINS, draw_craters
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.measure import value_at
from perilune_render.terrain.profile import REACH, crest_radius, profile_tables, wear_row
from perilune_render.terrain.scene import Scene, grow_scene
from perilune_render.terrain.size_frequency import EQUILIBRIA, Minimum, NeukumProduction
from perilune_shared.camera import Camera
from tests.render.conftest import config_with

EVEN = Grid.even(1500, 1500)


@pytest.fixture(scope="module")
def scene() -> Scene:
    config = config_with()
    return grow_scene(config, Camera.from_field_of_view(256, 256, 50.0), FlightConfig(), 7)


@pytest.mark.parametrize("law", sorted(EQUILIBRIA))
def test_the_size_frequency_asked_for(law):
    config = CratersConfig(equilibrium=law, equilibrium_share=Span(low=1.3, high=1.3), min_diameter_spacings=8)
    craters = draw_craters(config, EVEN, 5)
    wanted = Minimum(NeukumProduction(age_gyr=3.5), EQUILIBRIA[law](share=1.3))
    edges = np.array([8.0, 12, 18, 30, 50, 90, 200, 799])
    expected = -np.diff(wanted.csfd(edges)) * 3000.0**2
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

    No younger crater of `spared` their size took any of it, and no older one of nearly the same place and size has its
    own rim right behind.
    """
    c = scene.craters
    distance = np.maximum(np.abs(c.x_m), np.abs(c.y_m))
    wide = c.diameter_m > spacings * scene.grid.spacing_at(distance + c.diameter_m)
    wide &= (distance + c.diameter_m < scene.grid.extent_m / 2) & (c.origin == ORIGINS.index("primary"))
    for k in np.flatnonzero(wide):
        younger = np.arange(len(c)) > k
        apart = np.hypot(c.x_m - c.x_m[k], c.y_m - c.y_m[k])
        own, other = c.diameter_m[k] / 2, c.diameter_m / 2
        twin = ~younger & (apart < 0.55 * own) & (np.abs(other / own - 1) < 0.3) & (apart > 0)
        wide[k] = not (twin | (younger & (np.abs(apart - own) < 1.6 * other) & (other > spared * own))).any()
    return np.flatnonzero(wide)


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


def test_a_circle_fitted_to_every_fresh_crater_is_its_label():
    config = config_with()
    fits = []
    for seed in range(7, 15):
        scene = grow_scene(config, Camera.from_field_of_view(192, 192, 50.0), FlightConfig(), seed)
        c = scene.craters
        fresh = [k for k in settled(scene, 24, 0.1) if c.wear_m2[k] < 0.008 * (c.diameter_m[k] / 2) ** 2]
        fits += [fitted_radius(scene, k) for k in fresh]
    assert len(fits) >= 12
    assert np.abs(np.array(fits) - 1).max() < 0.02 and np.mean(fits) == pytest.approx(1, abs=0.004)


def test_slopes_grow_from_mare_to_highland():
    """Median bidirectional slopes at a baseline of 17 m, measured as altimeters do."""
    median = {}
    for name, relief, share in (("mare", 2.5, 1.2), ("highland", 6.0, 1.2)):
        craters = {"equilibrium_share": {"low": share, "high": share}}
        config = config_with(
            terrain={
                "relief": {"rms_slope_deg": {"low": relief, "high": relief}},
                "craters": craters,
                "spacing_px": 1.0,
            }
        )
        scene = grow_scene(config, Camera.from_field_of_view(192, 192, 50.0), FlightConfig(), 7)
        x, y = np.random.default_rng(1).uniform(-1000, 1000, (2, 20_000))
        rise = value_at(scene.height_m, scene.grid, x + 17, y) - value_at(scene.height_m, scene.grid, x, y)
        median[name] = np.degrees(np.arctan(np.median(np.abs(rise)) / 17))
    assert 0.6 < median["mare"] < 5 and 1.3 * median["mare"] < median["highland"] < 8
