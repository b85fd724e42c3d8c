"""Detectability of a known signal: exact in white noise, and monotonic in signal, noise and clutter."""

import numpy as np
import pytest

from perilune_render.detectability.observer import MAX_PIXELS, observe
from perilune_render.labels.pixels import REACH, contrasts

CENTRE = 20.3, 19.6
RADIUS_PX = 5.0
AXES = np.array([[0.8, -0.6], [0.6, 0.8]]) * RADIUS_PX


def offsets(axes=AXES, centre=CENTRE, n=40):
    """Offsets of all pixels along and across the Sun, radii."""
    y, x = np.mgrid[:n, :n] + 0.5
    away = np.stack([x - centre[0], y - centre[1]], axis=-1)
    return np.moveaxis(away @ np.linalg.inv(axes).T, -1, 0)


def bowl(axes=AXES, centre=CENTRE, n=40):
    """Shading of a bowl lit from one side."""
    s, t = offsets(axes, centre, n)
    return -s * np.exp(-(((s**2 + t**2) / 0.64) ** 2))


def inside(axes=AXES, centre=CENTRE, n=40):
    s, t = offsets(axes, centre, n)
    return s**2 + t**2 <= REACH**2


def without_plane(values, chosen):
    """Values of the chosen pixels after a least-squares fit of a plane."""
    s, t = offsets(n=len(values))
    terms = np.stack([np.ones(chosen.sum()), s[chosen], t[chosen]], axis=1)
    return values[chosen] - terms @ np.linalg.lstsq(terms, values[chosen], rcond=None)[0]


FLAT, WHITE = np.full((40, 40), 100.0), np.full((40, 40), 2.0)


def test_in_white_noise_it_is_the_norm_of_the_signal_over_the_noise():
    signal = 7.0 * bowl()
    seen = observe(signal, FLAT, WHITE, CENTRE, AXES)
    part = without_plane(signal, inside())
    assert inside().sum() < MAX_PIXELS
    assert seen.d_prime == pytest.approx(np.linalg.norm(part) / 2.0, rel=1e-9)
    assert seen.noise_sigma == pytest.approx(2.0)
    assert seen.clutter_sigma == pytest.approx(0.0, abs=1e-9)
    assert seen.signal_energy == pytest.approx((signal**2).sum())


def test_it_predicts_the_responses_to_noisy_images():
    """The response of the channel to drawn images separates by d' standard deviations."""
    signal, rng = 3.0 * bowl(), np.random.default_rng(4)
    template = without_plane(bowl(), inside())
    noise = rng.normal(0, 2.0, (4000, inside().sum()))
    response = noise @ template
    expected = template @ without_plane(signal, inside()) / response.std()
    assert observe(signal, FLAT, WHITE, CENTRE, AXES).d_prime == pytest.approx(expected, rel=0.05)


def test_it_rises_with_the_signal_and_falls_with_noise_and_clutter():
    rng = np.random.default_rng(5)
    texture = rng.normal(0, 1.0, FLAT.shape)
    values = [observe(k * bowl(), FLAT + texture, WHITE, CENTRE, AXES).d_prime for k in (1, 2, 4)]
    assert values == pytest.approx(values[0] * np.array([1, 2, 4]))
    louder = [observe(bowl(), FLAT + texture, k * WHITE, CENTRE, AXES).d_prime for k in (1, 2, 4)]
    assert louder[0] > louder[1] > louder[2]
    rougher = [observe(bowl(), FLAT + k * texture, WHITE, CENTRE, AXES) for k in (0, 2, 4)]
    assert rougher[0].d_prime > rougher[1].d_prime > rougher[2].d_prime > 0
    assert rougher[2].clutter_sigma == pytest.approx(4.0, rel=0.15)


def test_a_slope_of_brightness_is_no_clutter_and_no_signal():
    s, t = offsets()
    plane = 100 + 5 * s - 3 * t
    assert observe(bowl(), plane, WHITE, CENTRE, AXES).clutter_sigma == pytest.approx(0, abs=1e-9)
    assert observe(plane, FLAT, WHITE, CENTRE, AXES).d_prime == pytest.approx(0, abs=1e-9)


def test_clutter_elsewhere_does_not_matter():
    far = FLAT + np.where(inside(), 0.0, 50.0 * np.random.default_rng(6).normal(size=FLAT.shape))
    assert observe(bowl(), far, WHITE, CENTRE, AXES) == observe(bowl(), FLAT, WHITE, CENTRE, AXES)


def test_a_bump_is_negative():
    assert observe(-bowl(), FLAT, WHITE, CENTRE, AXES).d_prime < 0


def test_a_large_crater_counts_a_limited_number_of_pixels():
    axes, centre, n = 4 * AXES, (80.0, 80.0), 160
    seen = observe(bowl(axes, centre, n), np.zeros((n, n)), np.ones((n, n)), centre, axes)
    count = inside(axes, centre, n).sum()
    small = observe(bowl(), np.zeros((40, 40)), np.ones((40, 40)), CENTRE, AXES)
    # Of equal shape and brightness: the norm grows with the root of the number of pixels, up to the limit.
    assert count > MAX_PIXELS
    assert seen.d_prime == pytest.approx(small.d_prime * np.sqrt(MAX_PIXELS / inside().sum()), rel=0.02)


def test_a_crater_outside_the_image_has_no_detectability():
    assert observe(bowl(), FLAT, WHITE, (-30.0, 20.0), AXES).d_prime == 0


def test_an_isolated_crater_has_the_value_of_the_label_column_contrast():
    """Without clutter the fit of the contrast leaves no residual, so both are the same ratio."""
    grey = FLAT + 7.0 * bowl()
    contrast = contrasts(np.array([CENTRE]), AXES[None], grey, WHITE)
    assert observe(grey - FLAT, FLAT, WHITE, CENTRE, AXES).d_prime == pytest.approx(contrast[0], rel=1e-6)
