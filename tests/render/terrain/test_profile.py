from typing import get_args

import numpy as np
import pytest

from perilune_render.config.terrain import CratersConfig
from perilune_render.terrain.craters import profile
from perilune_render.terrain.size_frequency import EQUILIBRIA

PROFILES = ["fassett_thomson", "pangu"]


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("flat", [False, True])
def test_no_ring_second_differences_stay_bounded_as_the_step_shrinks(name, flat):
    """As dx shrinks, the second difference of a step stays, of a kink falls as dx, of a smooth curve as dx^2."""
    worst = []
    for n in (30_001, 300_001):
        x = np.linspace(0, 3.2, n)
        shape = 0.0368 * profile.fresh_rim(x, name) + 0.15 * profile.fresh_bowl(x, name, flat=flat)
        worst.append(np.abs(np.diff(shape, 2)).max() * (n - 1) ** 2)
    assert worst[1] < 1.1 * worst[0]


@pytest.mark.parametrize("name", PROFILES)
def test_the_finished_tables_have_no_ring_either(name):
    tables = profile.profile_tables(name)
    for shape in (0.0368 * tables.rim + 0.15 * tables.bowl, 0.0368 * tables.rim + 0.15 * tables.flat_bowl):
        bend = np.abs(np.diff(shape, 2, axis=1))
        # Beyond the blanket's end, and at the tables' own end, nothing bends as the crest of the new crater does.
        assert bend[:, 115:].max() < 0.35 * bend[0].max()


@pytest.mark.parametrize("name", PROFILES)
def test_the_bowl_is_one_deep_and_ends_at_the_rim(name):
    assert profile.fresh_bowl(np.array([0.0]), name)[0] == pytest.approx(-1)
    assert profile.fresh_bowl(np.array([1.0, 1.02, 2.0]), name) == pytest.approx([0, 0, 0], abs=1e-9)
    x = np.linspace(0, 3, 3001)
    assert (np.diff(profile.fresh_bowl(x, name)) >= -1e-12).all() and (
        np.diff(profile.fresh_rim(x, name)) <= 1e-12
    ).all()


def test_fassett_and_thomsons_flank_is_kept_where_it_is_not_rounded():
    # Eq. 4's outer polynomial over its value at 1.02, at places between the two roundings.
    x = np.array([1.1, 1.2, 1.3])
    outer = 0.188253307 - 0.187050452 * x + 0.01844746 * x**2 + 0.01505647 * x**3
    assert profile.fresh_rim(x) == pytest.approx(outer / 0.0325, rel=0.005)
    assert profile.fresh_rim(np.array([1.6, 2.5])) == pytest.approx([0, 0])


def test_pangus_bowl_is_a_parabola_and_its_ejecta_thin_as_the_cube():
    x = np.array([0.0, 0.3, 0.6, 0.8])
    assert profile.fresh_bowl(x, "pangu") == pytest.approx(x**2 - 1)
    assert profile.fresh_rim(np.array([1.5, 2.0]), "pangu") == pytest.approx([1.5**-3, 2.0**-3])


def test_a_flat_floor_is_flat():
    x = np.linspace(0, 0.35, 50)
    assert np.ptp(profile.fresh_bowl(x, flat=True)) < 0.02 < 0.1 < np.ptp(profile.fresh_bowl(x))


@pytest.mark.parametrize(("diameter_m", "ratio"), [(3, 0.10), (63, 0.13), (1000, 0.21)])
def test_fresh_depth_by_size(diameter_m, ratio):
    assert profile.fresh_depth_m(np.array([diameter_m]))[0] / diameter_m == pytest.approx(ratio)


def test_pikes_depth_and_the_rims():
    assert profile.fresh_depth_m(1000.0, "pike") == pytest.approx(196)
    assert profile.fresh_rim_height_m(1000.0, 200.0) == pytest.approx(36.8, rel=0.01)
    # McGetchin's ejecta exceed Pike's rim below 26 m and are capped there.
    assert profile.fresh_rim_height_m(10.0, 1.0, "pangu") == pytest.approx(36 * 0.01**1.014)
    assert profile.fresh_rim_height_m(200.0, 30.0, "pangu") == pytest.approx(0.14 * 100**0.74)


def test_wear_lowers_rim_and_fills_bowl():
    tables = profile.profile_tables()
    centre = -tables.bowl[:, 0]
    assert (np.diff(centre) < 0).all() and centre[0] > 0.95 and centre[-1] < 0.2
    crest = (0.0368 * tables.rim + 0.15 * tables.bowl).max(axis=1)
    assert (np.diff(crest) < 0).all() and crest[0] > 0.03 > 0.01 > crest[-1]


@pytest.mark.parametrize(("wear", "low", "high"), [(0.04, 0.57, 0.72), (0.25, 0.10, 0.20)])
def test_depth_left_agrees_with_published_degradation(wear, low, high):
    # Bounds: the fit of cratermaker and Gaussian blurring of the profile, which differ by about a tenth.
    tables = profile.profile_tables()
    row = np.log(wear / profile.MIN_WEAR) / np.log(profile.MAX_WEAR / profile.MIN_WEAR) * (profile.N_WEAR - 1)
    shape = (0.0368 * tables.rim + 0.2 * tables.bowl)[round(row)]
    fresh = (0.0368 * tables.rim + 0.2 * tables.bowl)[0]
    at_rim = round(1 / (profile.REACH / 300))
    assert low < (shape[at_rim] - shape[0]) / (fresh[at_rim] - fresh[0]) < high


def test_diffusion_keeps_the_volume():
    tables = profile.profile_tables()
    x = np.linspace(0, profile.REACH, 301)
    volume = (tables.bowl[:24] * x).sum(axis=1)
    assert np.allclose(volume, volume[0], rtol=5e-3)


def test_every_profile_of_the_settings_has_a_shape_of_its_own():
    """A name without a branch in profile.py would silently give another profile."""
    names = get_args(CratersConfig.model_fields["profile"].annotation)
    x = np.linspace(0, 3, 301)
    shapes = {profile.fresh_rim(x, name).tobytes() for name in names}
    assert sorted(names) == sorted(PROFILES) and len(shapes) == len(names)


def test_every_equilibrium_of_the_settings_is_registered():
    assert set(get_args(CratersConfig.model_fields["equilibrium"].annotation)) == set(EQUILIBRIA)
