"""Variations of pixels, by hand."""

import numpy as np
import pytest

from benchmarks.train.robust import VARIATIONS, grey_levels, jpeg, noise, sixteen_bits, stretch

RAMP = np.tile(np.arange(256, dtype=np.uint8), (64, 1))


def rng():
    return np.random.default_rng(1)


@pytest.mark.parametrize("name", VARIATIONS)
def test_a_variation_changes_the_grey_levels_and_not_the_picture(name):
    image = np.clip(RAMP.astype(int) + rng().integers(-9, 10, RAMP.shape), 0, 255).astype(np.uint8)
    before = image.copy()
    changed = VARIATIONS[name](image, rng())
    assert changed.shape == image.shape and changed.dtype == np.uint8
    assert np.array_equal(image, before)
    assert np.array_equal(changed, image) == (name == "as rendered")
    assert np.corrcoef(changed.ravel(), image.ravel())[0, 1] > 0.85


def test_the_extremes_of_a_stretch():
    changed = stretch(0.25, 0.1)(RAMP, rng())
    assert (changed == 0).mean() == pytest.approx(0.25, abs=0.01)
    assert (changed == 255).mean() == pytest.approx(0.1, abs=0.01)


def test_the_number_of_grey_levels():
    assert len(np.unique(grey_levels(12)(RAMP, rng()))) == 12
    assert np.abs(grey_levels(12)(RAMP, rng()).astype(int) - RAMP).max() <= 12


def test_sixteen_bits_are_read_in_proportion():
    """Both ends are cut at 0.05 % of the pixels, so the levels agree up to rounding and the added noise."""
    assert np.abs(sixteen_bits(RAMP, rng()).astype(int) - RAMP).max() <= 2


def test_blocks_and_noise_grow_with_their_strength():
    image = rng().integers(0, 256, (64, 64), np.uint8)

    def change(variation):
        return np.std(variation(image, rng()).astype(float) - image)

    assert change(jpeg(90)) < change(jpeg(75)) < change(jpeg(25))
    grey = np.full((64, 64), 128, np.uint8)
    assert np.std(noise(8.0)(grey, rng()).astype(float)) == pytest.approx(8, rel=0.05)
