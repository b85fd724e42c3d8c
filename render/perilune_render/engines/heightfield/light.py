"""Light at the points that rays hit: points on the Sun's disc, and photometry, compiled for speed.

The compiled Hapke law runs the operations of `perilune_shared.photometry` in the same order, in float32, and
calls the C library functions that NumPy calls, so the results are equal to the bit.
"""

import math
from typing import NamedTuple

import numpy as np

from perilune_render.engines.heightfield.surface import INLINED, WITHOUT_COUNTS
from perilune_render.provenance.kernels import njit
from perilune_shared.photometry import (
    HAPKE,
    LUNAR_LAMBERT_SCALE,
    MIN_SINE_SQUARED,
    HapkeParameters,
    chi_of,
    reflectance_factor,
    slope_of,
)

_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_MIN_SINE_SQUARED, _TURN = np.float32(MIN_SINE_SQUARED), np.float32(2 * np.pi)


class _Factors(NamedTuple):
    """Constants of Hapke's law, float32, in the order of the formulas."""

    exponent_1: np.float32
    exponent_2: np.float32
    slope: np.float32
    psi: np.float32
    per_chi: np.float32
    chi: np.float32
    total_above: np.float32
    product_above: np.float32
    product_below: np.float32
    total_below: np.float32
    lobes: np.float32
    lobe_sum: np.float32
    backward: np.float32
    forward: np.float32
    surge: np.float32
    h_s: np.float32
    albedo: np.float32


def _factors(p: HapkeParameters) -> _Factors:
    """The constants of a parameter set, computed in double precision and rounded once, as in NumPy."""
    slope, chi, gamma = slope_of(p.theta_bar_deg), chi_of(p.theta_bar_deg), float(np.sqrt(1 - p.w))
    scale = (1 - p.b**2) / 2
    values = (
        -2 / np.pi / slope,
        -np.pi / 4,
        slope,
        -1 / np.pi,
        1 / chi,
        chi,
        2 - 2 * gamma,
        4 - 4 * gamma**2,
        4 * gamma**2,
        2 * gamma,
        2 * p.b,
        1 + p.b**2,
        scale * (1 + p.c),
        scale * (1 - p.c),
        p.b_s0 * p.h_s,
        p.h_s,
        p.w / 4,
    )
    return _Factors(*map(np.float32, values))


def disc_places(drawn: np.ndarray, radius_rad: np.float32) -> np.ndarray:
    """Uniform points (..., 2) on the Sun's disc at unit distance, float32.

    `drawn` (..., 2) are uniform random numbers.
    """
    points = np.empty(drawn.shape, np.float32)
    _fill_disc(drawn, radius_rad, points)
    return points


def reflected(law: str, angles: np.ndarray) -> np.ndarray:
    """Radiance factor (...) of a law for the `angles` (5, ...) float32 that `shade.see` writes."""
    mu0, mu, cos_phase, albedo, lit = angles
    if law not in HAPKE:
        return reflectance_factor(law, mu0, mu, cos_phase) * albedo * lit
    factor = np.empty(mu0.shape, np.float32)
    _hapke(_factors(HAPKE[law]), angles.reshape(5, -1), factor.reshape(-1))
    return factor


@njit(**INLINED)
def disc_place(radius_rad, first, second):
    """Point of the Sun's disc at unit distance from two uniform numbers, as `disc_places`."""
    length, angle = math.tan(radius_rad * math.sqrt(first)), _TURN * second
    return length * math.cos(angle), length * math.sin(angle)


@njit(**WITHOUT_COUNTS)
def _fill_disc(drawn, radius_rad, points):
    n_samples, height, width, _ = drawn.shape
    for s in range(n_samples):
        for i in range(height):
            for j in range(width):
                points[s, i, j, 0], points[s, i, j, 1] = disc_place(radius_rad, drawn[s, i, j, 0], drawn[s, i, j, 1])


@njit(**INLINED)
def _slopes(f, cosine):
    """Compiled copy of `photometry._slopes`."""
    sine = math.sqrt(max(cosine * cosine * -_ONE + _ONE, _MIN_SINE_SQUARED))
    exponent = cosine / sine * f.exponent_1
    return sine, math.exp(exponent), math.exp(exponent * exponent * f.exponent_2)


@njit(**INLINED)
def hapke_factor(f, mu0, mu, cos_phase):
    """Compiled copy of `photometry.hapke` for float32 numbers; `f` are the constants of a parameter set."""
    cos_l, cos_s = min(mu0, mu), max(mu0, mu)
    sin_l, e1_l, e2_l = _slopes(f, cos_l)
    sin_s, e1_s, e2_s = _slopes(f, cos_s)
    open_l, open_s = _TWO - e1_l, _TWO - e1_s
    cos_psi = min(max((cos_phase - mu0 * mu) / (sin_l * sin_s), -_ONE), _ONE)
    psi = math.acos(cos_psi)
    seen_as_one = math.exp(math.tan(psi * np.float32(0.499999)) * -_TWO)
    per_both = f.slope / max(psi * e1_s * f.psi + open_l, np.float32(1e-4))
    common = (cos_psi * np.float32(-0.5) + np.float32(0.5)) * e2_s
    larger = sin_l * (e2_l - common) * per_both + cos_l
    smaller = sin_s * (cos_psi * e2_l + common) * per_both + cos_s
    alone_l = sin_l * e2_l / open_l * f.slope + cos_l
    alone_s = sin_s * e2_s / open_s * f.slope + cos_s
    shadowing = f.per_chi / (alone_l * (seen_as_one * (cos_s - alone_s) + alone_s))
    larger, smaller = larger * f.chi, smaller * f.chi
    total, product = larger + smaller, larger * smaller
    multiple = (total * f.total_above + product * f.product_above) / (
        product * f.product_below + (total * f.total_below + _ONE)
    )
    phase = (cos_phase * -f.lobes + f.lobe_sum) ** np.float32(-1.5) * f.backward + (
        cos_phase * f.lobes + f.lobe_sum
    ) ** np.float32(-1.5) * f.forward
    half_tangent = math.sqrt(_TWO / min(cos_phase + _ONE, _TWO) - _ONE)
    surge = f.surge / (half_tangent + f.h_s) + _ONE
    return product / total * (shadowing * f.albedo) * (phase * surge + multiple)


LAW_NUMBERS = {name: number for number, name in enumerate([*HAPKE, "lommel_seeliger", "lunar_lambert", "lambert"])}
"""Number of each law for `factor_of`."""
_N_HAPKE = len(HAPKE)
_HALF_TURN = np.float32(180 / np.pi)


def factors_of(law: str) -> _Factors:
    """Constants of a law for `factor_of`; zeros for a law without constants."""
    return _factors(HAPKE[law]) if law in HAPKE else _Factors(*[np.float32(0)] * len(_Factors._fields))


@njit(**INLINED)
def factor_of(law, f, mu0, mu, cos_phase):
    """`photometry.reflectance_factor` for float32 numbers; `law` is a number of LAW_NUMBERS."""
    if law < _N_HAPKE:
        return hapke_factor(f, mu0, mu, cos_phase)
    if law == _N_HAPKE:
        return np.float32(0.1) / (mu0 + mu)
    if law == _N_HAPKE + 1:
        g = math.acos(min(max(cos_phase, -_ONE), _ONE)) * _HALF_TURN
        share = max(_ONE + g * (np.float32(-0.019) + g * (np.float32(2.42e-4) + g * np.float32(-1.46e-6))), _ZERO)
        return np.float32(LUNAR_LAMBERT_SCALE) * (_TWO * share / (mu0 + mu) + (_ONE - share))
    return np.float32(0.12)


@njit(**WITHOUT_COUNTS)
def _hapke(f, angles, result):
    """Write the radiance factor of each sample to `result` (N,), given `angles` (5, N).

    The radiance factor is the product of `photometry.hapke`, the albedo and the cosine of incidence (0 in shadow).
    """
    for k in range(len(result)):
        result[k] = hapke_factor(f, angles[0, k], angles[1, k], angles[2, k]) * angles[3, k] * angles[4, k]
