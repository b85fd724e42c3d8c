import numpy as np
import pytest

from perilune_render.terrain import profile


def test_the_fresh_profile_has_no_step():
    x = np.linspace(0, 3, 30_001)
    for shape in (profile.fresh_rim(x), profile.fresh_bowl(x)):
        assert np.abs(np.diff(shape)).max() < 1e-3


def test_the_bowl_is_one_deep_and_ends_at_the_rim():
    assert profile.fresh_bowl(np.array([0.0]))[0] == pytest.approx(-1)
    assert profile.fresh_bowl(np.array([0.98, 1.0, 2.0])) == pytest.approx([0, 0, 0], abs=1e-3)


def test_the_rim_stands_0_037_diameters_above_the_plain_and_the_blanket_ends():
    assert profile.fresh_rim(np.array([1.0, 1.02, 1.5, 2.5])) == pytest.approx([0.036822, 0.036822, 0, 0], abs=1e-4)


@pytest.mark.parametrize(("diameter_m", "ratio"), [(3, 0.10), (63, 0.13), (1000, 0.21)])
def test_fresh_depth_by_size(diameter_m, ratio):
    assert profile.fresh_depth_ratio(np.array([diameter_m]))[0] == pytest.approx(ratio)


def test_wear_lowers_rim_and_fills_bowl():
    tables = profile.profile_tables()
    centre = -tables.bowl[:, 0]
    assert (np.diff(centre) < 0).all() and centre[0] > 0.95 and centre[-1] < 0.2
    crest = (tables.rim + 0.15 * tables.bowl).max(axis=1)
    assert (np.diff(crest) < 0).all() and crest[0] > 0.03 > 0.01 > crest[-1]


@pytest.mark.parametrize(("wear", "low", "high"), [(0.04, 0.57, 0.72), (0.25, 0.10, 0.20)])
def test_depth_left_agrees_with_published_degradation(wear, low, high):
    # Bounds: the fit of cratermaker and Gaussian blurring of the profile, which differ by about a tenth.
    tables = profile.profile_tables()
    row = np.log(wear / profile.LEAST_WEAR) / np.log(profile.MOST_WEAR / profile.LEAST_WEAR) * (profile.N_WEAR - 1)
    shape = (tables.rim + 0.2 * tables.bowl)[round(row)]
    fresh = (tables.rim + 0.2 * tables.bowl)[0]
    at_rim = round(1 / (profile.REACH / 300))
    assert low < (shape[at_rim] - shape[0]) / (fresh[at_rim] - fresh[0]) < high


def test_diffusion_keeps_the_volume():
    tables = profile.profile_tables()
    x = np.linspace(0, profile.REACH, 301)
    volume = (tables.bowl[:24] * x).sum(axis=1)
    assert np.allclose(volume, volume[0], rtol=5e-3)
