import dataclasses
import itertools
import math

import numpy as np
import pytest

from perilune_shared.photometry import HIGHLAND, LAWS, MARE, MEAN, hapke, radiance_factor, roughness

GEOMETRIES = list(
    itertools.product((0, 10, 30, 45, 60, 70, 80, 85), (0, 15, 30, 45, 60, 75, 85), (0, 30, 60, 90, 120, 150, 180))
)
"""Incidence, emission and azimuth, degrees."""


def scalar_roughness(theta_bar, i, e, psi):
    """The printed formulas for mu0e, mue and S, case by case, as an independent twin; all angles radians."""
    tan = math.tan(theta_bar)
    chi = 1 / math.sqrt(1 + math.pi * tan**2)

    def e1(x):
        return math.exp(-2 / math.pi / tan / math.tan(x)) if x > 0 else 0.0

    def e2(x):
        return math.exp(-1 / math.pi / tan**2 / math.tan(x) ** 2) if x > 0 else 0.0

    def eta(x):
        return chi * (math.cos(x) + math.sin(x) * tan * e2(x) / (2 - e1(x)))

    half = math.sin(psi / 2) ** 2
    f = math.exp(-2 * math.tan(psi / 2)) if psi < math.pi else 0.0
    if i <= e:
        below = 2 - e1(e) - psi / math.pi * e1(i)
        mu0e = chi * (math.cos(i) + math.sin(i) * tan * (math.cos(psi) * e2(e) + half * e2(i)) / below)
        mue = chi * (math.cos(e) + math.sin(e) * tan * (e2(e) - half * e2(i)) / below)
        s = mue / eta(e) * math.cos(i) / eta(i) * chi / (1 - f + f * chi * math.cos(i) / eta(i))
    else:
        below = 2 - e1(i) - psi / math.pi * e1(e)
        mu0e = chi * (math.cos(i) + math.sin(i) * tan * (e2(i) - half * e2(e)) / below)
        mue = chi * (math.cos(e) + math.sin(e) * tan * (math.cos(psi) * e2(i) + half * e2(e)) / below)
        s = mue / eta(e) * math.cos(i) / eta(i) * chi / (1 - f + f * chi * math.cos(e) / eta(e))
    return mu0e, mue, s


def scalar_hapke(p, mu0e, mue, s, g):
    """The printed formula for I/F, as an independent twin."""
    lobes = [(1 - p.b * p.b) / (1 + sign * 2 * p.b * math.cos(g) + p.b * p.b) ** 1.5 for sign in (-1, 1)]
    phase = (1 + p.c) / 2 * lobes[0] + (1 - p.c) / 2 * lobes[1]
    surge = p.b_s0 / (1 + math.tan(g / 2) / p.h_s)
    h0, h = ((1 + 2 * x) / (1 + 2 * x * math.sqrt(1 - p.w)) for x in (mu0e, mue))
    return p.w / 4 * mu0e / (mu0e + mue) * (phase * (1 + surge) + h0 * h - 1) * s


def phase_angle(i, e, psi):
    """Phase angle of incidence, emission and azimuth, radians."""
    return math.acos(min(math.cos(i) * math.cos(e) + math.sin(i) * math.sin(e) * math.cos(psi), 1))


@pytest.mark.parametrize(("law", "parameters"), [("hapke_highland", HIGHLAND), ("hapke_mare", MARE)])
def test_hapke_is_the_printed_formula(law, parameters):
    for degrees in GEOMETRIES:
        i, e, psi = (math.radians(x) for x in degrees)
        g = phase_angle(i, e, psi)
        expected = scalar_hapke(parameters, *scalar_roughness(math.radians(23.657), i, e, psi), g)
        found = radiance_factor(law, math.cos(i), math.cos(e), math.cos(g))
        assert found == pytest.approx(expected, rel=2e-5), degrees


@pytest.mark.parametrize("theta_bar_deg", [5.0, 23.657, 40.0])
def test_effective_cosines_and_shadowing_are_the_printed_ones(theta_bar_deg):
    for degrees in GEOMETRIES:
        i, e, psi = (math.radians(x) for x in degrees)
        mu0, mu = math.cos(i), math.cos(e)
        larger, smaller, shadowing = roughness(theta_bar_deg, mu0, mu, math.cos(phase_angle(i, e, psi)))
        mu0e, mue = (smaller, larger) if i <= e else (larger, smaller)
        found = mu0e, mue, shadowing * mu0 * mue
        assert found == pytest.approx(scalar_roughness(math.radians(theta_bar_deg), i, e, psi), rel=2e-5), degrees


CHANDRASEKHAR = {0.0: 1.0, 0.1: 1.2474, 0.2: 1.4504, 0.5: 2.0128, 1.0: 2.9078}
"""H(mu) of isotropic scattering without absorption (Chandrasekhar 1960, "Radiative Transfer", table XI)."""


def test_multiple_scattering_is_within_eight_percent_of_the_exact_solution():
    """Isotropic scattering without absorption, surge and roughness, for which I/F = mu0 / (mu0 + mu) H(mu0) H(mu) / 4.

    Each of the two values of H that Hapke approximates is wrong by up to 4 percent.
    """
    isotropic = dataclasses.replace(HIGHLAND, w=1.0, b=0.0, c=0.0, b_s0=0.0, theta_bar_deg=1e-3)
    for mu0, mu in itertools.product((0.1, 0.2, 0.5, 1.0), repeat=2):
        exact = mu0 / (mu0 + mu) * CHANDRASEKHAR[mu0] * CHANDRASEKHAR[mu] / 4
        found = mu0 * hapke(isotropic, mu0, mu, 0.3)
        assert 0.92 < found / exact < 1.08, (mu0, mu, found / exact)


def test_isotropic_single_scattering_is_lommel_and_seeligers():
    faint = dataclasses.replace(HIGHLAND, w=1e-6, b=0.0, c=0.0, b_s0=0.0, theta_bar_deg=1e-3)
    mu0, mu, cos_phase = directions(12, 85)
    ratio = hapke(faint, mu0, mu, cos_phase) / radiance_factor("lommel_seeliger", mu0, mu, cos_phase) * mu0
    np.testing.assert_allclose(ratio, 1e-6 / 0.4, rtol=1e-5)


def directions(n_cosines, largest_deg):
    """A grid of mu0, mu and cos of the phase angle."""
    cosines = np.linspace(math.cos(math.radians(largest_deg)), 1, n_cosines)
    mu0, mu, psi = np.meshgrid(cosines, cosines, np.linspace(0, np.pi, 37))
    return mu0, mu, mu0 * mu + np.sqrt((1 - mu0**2) * (1 - mu**2)) * np.cos(psi)


def test_without_roughness_the_smooth_law_is_left():
    mu0, mu, cos_phase = directions(12, 88)
    smooth = dataclasses.replace(HIGHLAND, theta_bar_deg=1e-3)
    found = mu0 * hapke(smooth, mu0, mu, cos_phase)
    flat = zip(mu0.ravel(), mu.ravel(), cos_phase.ravel(), strict=True)
    expected = [scalar_hapke(HIGHLAND, a, b, 1.0, math.acos(min(g, 1))) for a, b, g in flat]
    assert np.allclose(found.ravel(), expected, rtol=1e-6)


def test_shadows_take_light_away():
    mu0, mu, cos_phase = directions(60, 85)
    larger, smaller, shadowing = roughness(23.657, mu0, mu, cos_phase)
    s = shadowing * mu0 * np.where(mu0 > mu, larger, smaller)
    # The formula as printed passes 1, by under a hundredth where the view is within 60 degrees of the normal.
    assert (s > 0).all() and s[mu >= 0.5].max() < 1.01 and s.max() < 1.07
    assert s[(mu0 > 0.999) & (mu > 0.5)].max() < 1.0001
    assert s[(mu0 < 0.2) & (mu > 0.5) & (cos_phase < 0.2)].max() < 0.8


def test_laws_are_smooth_where_incidence_is_emission():
    psi = np.radians(np.arange(0, 181, 15))
    for angle in np.radians([20, 45, 60, 75, 84]):
        below, at, above = (
            radiance_factor(
                "hapke_mean",
                np.cos(angle + step),
                np.cos(angle),
                np.cos(angle + step) * np.cos(angle) + np.sin(angle + step) * np.sin(angle) * np.cos(psi),
            )
            for step in (-1e-5, 0.0, 1e-5)
        )
        assert np.allclose(below, at, rtol=1e-3) and np.allclose(above, at, rtol=1e-3)


def test_the_moon_is_as_bright_as_the_nac_sees_it():
    # Published fit to NAC images, in nadir view ln(I/F) = -2.98 - 0.011 g - 0.81 cos e + 1.32 cos i.
    incidence = np.arange(5, 81)
    mu0 = np.cos(np.radians(incidence))
    fit = np.exp(-2.98 - 0.011 * incidence - 0.81 + 1.32 * mu0)
    mean, mare, highland, simple = (
        radiance_factor(law, mu0, 1.0, mu0) / fit
        for law in ("hapke_mean", "hapke_mare", "hapke_highland", "lunar_lambert")
    )
    assert mean.mean() == pytest.approx(1, abs=0.002) and simple.mean() == pytest.approx(1, abs=0.002)
    assert ((mean > 0.62) & (mean < 1.2)).all() and (mean[incidence <= 70] > 0.9).all()
    assert ((simple > 0.6) & (simple < 1.3)).all()
    # Darker and brighter ground lie on either side.
    assert 0.9 < mare.mean() < 1 and 1.7 < highland.mean() < 2.1


def test_the_mean_moon_lies_between_mare_and_highland():
    for name in ("w", "b", "c", "b_s0", "h_s"):
        low, high = sorted((getattr(MARE, name), getattr(HIGHLAND, name)))
        assert low < getattr(MEAN, name) < high
        if name != "w":
            assert getattr(MEAN, name) == pytest.approx((low + high) / 2)


def test_lunar_lambert_goes_from_the_moons_law_to_lamberts():
    def share(mu0, mu, phase_deg):
        full = radiance_factor("lunar_lambert", 1.0, 1.0, 1.0)
        return radiance_factor("lunar_lambert", mu0, mu, np.cos(np.radians(phase_deg))) / full

    assert share(0.3, 0.6, 0) == pytest.approx(2 * 0.3 / 0.9)
    # L(30 degrees) = 1 - 0.57 + 0.2178 - 0.03942
    assert share(0.7, 0.9, 30) == pytest.approx(2 * 0.60838 * 0.7 / 1.6 + 0.39162 * 0.7)
    assert share(0.3, 0.6, 110) == pytest.approx(0.3)


def test_the_opposition_surge_brightens_the_full_moon():
    full, later = (radiance_factor("hapke_mare", 1.0, 1.0, np.cos(np.radians(g))) for g in (0.1, 10))
    assert full > 1.3 * later


@pytest.mark.parametrize("law", LAWS)
def test_laws_obey_reciprocity_and_take_arrays(law):
    mu0, mu, g = np.array([0.9, 0.3]), np.array([0.5, 0.8]), np.array([0.4, 0.1])
    there, back = radiance_factor(law, mu0, mu, g) / mu0, radiance_factor(law, mu, mu0, g) / mu
    assert np.allclose(there, back) and (there > 0).all()
