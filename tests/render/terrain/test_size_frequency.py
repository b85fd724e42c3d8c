import numpy as np
import pytest

from perilune_render.terrain.size_frequency import (
    BoulderLaw,
    ChangE4Equilibrium,
    Minimum,
    MintonEquilibrium,
    NeukumProduction,
    TraskEquilibrium,
    ViperEquilibrium,
    draw_diameters,
    log_bins,
)


@pytest.mark.parametrize(("diameter_m", "per_km2"), [(10, 21_700), (30, 757), (100, 16.6), (300, 0.41)])
def test_production_at_3_5_gyr(diameter_m, per_km2):
    assert NeukumProduction(age_gyr=3.5).csfd(diameter_m) * 1e6 == pytest.approx(per_km2, rel=0.02)


@pytest.mark.parametrize(("diameter_m", "per_km2"), [(10, 794), (30, 88), (100, 7.9), (300, 0.88)])
def test_trask_equilibrium(diameter_m, per_km2):
    assert TraskEquilibrium().csfd(diameter_m) * 1e6 == pytest.approx(per_km2, rel=0.01)


def test_one_kilometre_crater_per_area_and_time():
    # N(1 km) at 1 Gyr is 5.44e-14 (e^6.93 - 1) + 8.38e-4 per km^2.
    assert NeukumProduction(age_gyr=1.0).csfd(1000.0) * 1e6 == pytest.approx(8.38e-4 + 5.44e-14 * (np.exp(6.93) - 1))


def test_production_is_continuous_at_ten_metres():
    law = NeukumProduction(age_gyr=3.5)
    assert law.csfd(9.999) == pytest.approx(law.csfd(10.001), rel=1e-3)
    assert law.csfd(5.0) > law.csfd(9.9)


def test_boulders_above_a_metre():
    assert BoulderLaw(density=2.0).csfd(1.0) == pytest.approx(6e-4)


def test_the_minimum_changes_over_once():
    law = Minimum(NeukumProduction(age_gyr=3.5), TraskEquilibrium())
    assert law.csfd(10.0) == TraskEquilibrium().csfd(10.0) and law.csfd(300.0) == NeukumProduction(age_gyr=3.5).csfd(
        300.0
    )


def test_a_drawn_population_follows_its_law():
    law, edges, area = TraskEquilibrium(), log_bins(10, 200), 4e7
    drawn = draw_diameters(law, edges, np.full(len(edges) - 1, area), np.random.default_rng(5))
    for diameter in (10, 14, 20, 40, 80):
        expected = (law.csfd(diameter) - law.csfd(200)) * area
        assert abs((drawn >= diameter).sum() - expected) < 4 * np.sqrt(expected)
    assert drawn.min() >= 10 and drawn.max() <= 200


def test_each_bin_has_its_own_area():
    edges = np.array([10.0, 20.0, 40.0])
    drawn = draw_diameters(TraskEquilibrium(), edges, np.array([0.0, 1e7]), np.random.default_rng(1))
    assert len(drawn) and drawn.min() >= 20


@pytest.mark.parametrize(("diameter_m", "per_km2"), [(10, 336), (30, 37), (100, 3.4)])
def test_minton_equilibrium(diameter_m, per_km2):
    assert MintonEquilibrium().csfd(diameter_m) * 1e6 == pytest.approx(per_km2, rel=0.02)


def test_viper_equilibrium():
    assert ViperEquilibrium().csfd(1.0) * 1e6 == pytest.approx(29174)
    assert ViperEquilibrium().csfd(80.0) * 1e6 == pytest.approx(6.47, rel=0.01)


LAWS = [
    NeukumProduction(age_gyr=3.5, max_diameter_m=1000.0),
    TraskEquilibrium(min_diameter_m=10.0),
    MintonEquilibrium(min_diameter_m=10.0),
    ViperEquilibrium(min_diameter_m=5.0),
    ChangE4Equilibrium(min_diameter_m=2.0),
    BoulderLaw(min_diameter_m=1.0),
    Minimum(NeukumProduction(age_gyr=3.5), TraskEquilibrium()),
]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
def test_drawn_diameters_follow_each_law(law):
    low, high = law.min_diameter_m, law.max_diameter_m
    edges, area = log_bins(low, high), 1e5 / float(law.csfd(low) - law.csfd(high))
    drawn = np.sort(draw_diameters(law, edges, np.full(len(edges) - 1, area), np.random.default_rng(3)))
    assert abs(len(drawn) - 1e5) < 4 * np.sqrt(1e5)
    assert drawn[0] >= low and drawn[-1] <= high
    # Kolmogorov-Smirnov: the largest gap stays below its value at a chance of one in ten thousand.
    below = (law.csfd(low) - law.csfd(drawn)) / (law.csfd(low) - law.csfd(high))
    assert np.abs(below - (np.arange(len(drawn)) + 0.5) / len(drawn)).max() < 2.23 / np.sqrt(len(drawn))
