"""Compiled photometry and points of the Sun's disc are those of NumPy to the bit."""

import numpy as np
import pytest

from perilune_render.engines.heightfield.light import disc_places, reflected
from perilune_shared.photometry import LAWS, reflectance_factor


def angles_of_samples():
    """Angles (5, S, h, w) as `see` writes them, random and at the ends of their ranges."""
    rng = np.random.default_rng(7)
    angles = rng.random((5, 2, 50, 64)).astype(np.float32)
    angles[2] = 2 * angles[2] - 1
    angles[:2] = np.maximum(angles[:2], np.float32(1e-4))
    ends = np.array([[1e-4, 1e-4, -0.9999], [1, 1, 1], [1, 1e-4, 0], [1e-4, 1, 0], [0.5, 0.5, 1], [1e-4, 1e-4, 1]])
    angles[:3, 0, 0, : len(ends)] = ends.T
    angles[4, 1, 0] = 0
    return angles


@pytest.mark.parametrize("law", LAWS)
def test_compiled_photometry_is_that_of_numpy(law):
    angles = angles_of_samples()
    mu0, mu, cos_phase, albedo, lit = angles
    expected = reflectance_factor(law, mu0, mu, cos_phase) * albedo * lit
    found = reflected(law, angles)
    assert found.dtype == expected.dtype == np.float32
    np.testing.assert_array_equal(found.view(np.uint32), expected.view(np.uint32))


def test_points_of_the_disc_are_those_of_numpy():
    drawn = np.random.default_rng(8).random((2, 50, 64, 2), np.float32)
    drawn[0, 0, 0], drawn[0, 0, 1] = 0, 1 - 2**-24
    radius = np.float32(np.radians(0.53) / 2)
    length, angle = np.tan(radius * np.sqrt(drawn[..., 0])), np.float32(2 * np.pi) * drawn[..., 1]
    expected = np.stack([length * np.cos(angle), length * np.sin(angle)], axis=-1)
    found = disc_places(drawn, radius)
    np.testing.assert_array_equal(found.view(np.uint32), expected.view(np.uint32))
    assert np.hypot(found[..., 0], found[..., 1]).max() <= np.tan(radius) * 1.0001
