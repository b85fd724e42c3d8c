import math

import numpy as np
import pytest

from perilune_render.photometry import HIGHLAND, LAWS, radiance_factor


def scalar_hapke(w, b, c, b_s0, h_s, incidence, emission, phase):
    """The printed formula, angle by angle, as an independent twin."""
    mu0, mu = math.cos(incidence), math.cos(emission)
    lobes = [(1 - b * b) / (1 + sign * 2 * b * math.cos(phase) + b * b) ** 1.5 for sign in (-1, 1)]
    p = (1 + c) / 2 * lobes[0] + (1 - c) / 2 * lobes[1]
    surge = b_s0 / (1 + math.tan(phase / 2) / h_s)
    h0, h = ((1 + 2 * x) / (1 + 2 * x * math.sqrt(1 - w)) for x in (mu0, mu))
    return w / 4 * mu0 / (mu0 + mu) * (p * (1 + surge) + h0 * h - 1)


@pytest.mark.parametrize(
    ("incidence", "emission", "phase"), [(0, 0, 0), (30, 0, 30), (70, 20, 85), (45, 45, 10), (85, 5, 90)]
)
def test_hapke_is_the_printed_formula(incidence, emission, phase):
    i, e, g = np.radians([incidence, emission, phase])
    expected = scalar_hapke(HIGHLAND.w, HIGHLAND.b, HIGHLAND.c, HIGHLAND.b_s0, HIGHLAND.h_s, i, e, g)
    assert radiance_factor("hapke_highland", np.cos(i), np.cos(e), np.cos(g)) == pytest.approx(expected, rel=1e-9)


def test_the_moon_is_as_bright_as_the_nac_sees_it():
    # Published fit to NAC images in nadir view, ln(I/F) = -2.98 - 0.011 g - 0.81 cos e + 1.32 cos i:
    # it runs through our mare within a quarter, and highlands are about twice as bright.
    for incidence in (5, 20, 40, 60, 70, 80):
        mu0 = np.cos(np.radians(incidence))
        fit = math.exp(-2.98 - 0.011 * incidence - 0.81 + 1.32 * mu0)
        assert radiance_factor("hapke_mare", mu0, 1.0, mu0) == pytest.approx(fit, rel=0.25)
        assert 1.4 < radiance_factor("hapke_highland", mu0, 1.0, mu0) / fit < 2.3


def test_the_opposition_surge_brightens_the_full_moon():
    full, later = (radiance_factor("hapke_mare", 1.0, 1.0, np.cos(np.radians(g))) for g in (0.1, 10))
    assert full > 1.3 * later


@pytest.mark.parametrize("law", LAWS)
def test_laws_obey_reciprocity_and_take_arrays(law):
    mu0, mu, g = np.array([0.9, 0.3]), np.array([0.5, 0.8]), np.array([0.4, 0.1])
    there, back = radiance_factor(law, mu0, mu, g) / mu0, radiance_factor(law, mu, mu0, g) / mu
    assert np.allclose(there, back) and (there > 0).all()
