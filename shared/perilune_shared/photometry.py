"""Reflectance laws of the lunar surface, written once for NumPy arrays and for Blender's shader.

Theory: a law gives the reflectance factor as a function of mu0 = cos i, mu = cos e and the cosine of the phase angle g,
where i is the angle of incidence and e the angle of emission. The reflectance factor is the radiance divided by the
radiance of a perfectly diffusing plate under the same light. Multiplied by mu0, it is the radiance factor I/F: the
radiance divided by the radiance of the plate lit from the zenith. The phase angle equals i + e only in the principal
plane and if Sun and observer are on opposite sides of the normal.

`perilune_render.engines.heightfield.light` has a compiled copy of Hapke's law. A test checks that the results of both
are equal to the bit.

    mu0, mu, phase_rad = np.cos(0.5), 1.0, 0.5                       # a view from the zenith
    radiance_factor("hapke_mare", mu0, mu, np.cos(phase_rad))        # I/F, 0.0515

The functions use only arithmetic and NumPy's ufuncs, so that `perilune_render.engines.blender.nodes` can call them with
symbols and build shader nodes from the same code. Sources: docs/reference/sources.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

Law = Callable[[Any, Any, Any], Any]

MIN_SINE_SQUARED = 1e-7
"""Smallest sine squared of i and e, against division by 0; at such small angles the roughness terms vanish anyway."""


@dataclass(frozen=True, slots=True)
class HapkeParameters:
    """Parameters of Hapke's model in the form of Sato et al. 2014 (doi 10.1002/2013JE004580)."""

    w: float
    """Single-scattering albedo."""
    b: float
    """Width of the double Henyey-Greenstein lobes."""
    c: float
    """Weight of the backward lobe, from -1 to 1."""
    b_s0: float
    """Amplitude of the shadow-hiding opposition surge."""
    h_s: float
    """Width of the surge: the value of tan(g/2) at which the surge falls to half of b_s0."""
    theta_bar_deg: float = 23.657
    """Mean slope of macroscopic roughness, > 0, degrees (Sato et al. 2014)."""


HIGHLAND = HapkeParameters(0.385, 0.2375, 0.325, 1.686, 0.0672)
"""Parameters for highland: median of latitudes within 30 degrees, 643 nm (Sato et al. 2014)."""
MARE = HapkeParameters(0.222, 0.254, 0.160, 1.993, 0.0597)
"""Parameters for mare: Mare Tranquillitatis, 643 nm (Sato et al. 2014)."""
MEAN = HapkeParameters(0.2242, 0.24575, 0.2425, 1.8395, 0.06345)
"""Parameters for the mean Moon: b, c, B_S0 and h_S are midway between mare and highland; we fitted w.

With this w, the ratio of the law to a published fit to NAC images has a mean of 1 for incidences of 5 to 80 degrees in
nadir view. The published fit is ln(I/F) = -2.98 - 0.011 g - 0.81 cos e + 1.32 cos i. The ratio is 0.92 to 1.19 up to 70
degrees and falls to 0.63 at 80 degrees, where the law is darker than the fit.
"""


def hapke(parameters: HapkeParameters, mu0: Any, mu: Any, cos_phase: Any) -> Any:
    """Hapke's reflectance factor with shadow hiding, multiple scattering and macroscopic roughness.

    I/F = w/4 mu0e/(mu0e+mue) [p(g) (1 + B_S0 / (1 + tan(g/2)/h_S)) + H(mu0e) H(mue) - 1] S,
    H(x) = (1+2x)/(1+2x sqrt(1-w)); `roughness` computes mu0e, mue and S. The reflectance factor is I/F divided by mu0
    and is symmetric in incidence and emission.
    """
    p = parameters
    larger, smaller, shadowing = roughness(p.theta_bar_deg, mu0, mu, cos_phase)
    total, product = larger + smaller, larger * smaller
    gamma = float(np.sqrt(1 - p.w))
    # H(mu0e) H(mue) - 1, expanded.
    multiple = (total * (2 - 2 * gamma) + product * (4 - 4 * gamma**2)) / (
        product * (4 * gamma**2) + (total * (2 * gamma) + 1)
    )
    scale = (1 - p.b**2) / 2
    phase = (cos_phase * (-2 * p.b) + (1 + p.b**2)) ** -1.5 * (scale * (1 + p.c)) + (
        cos_phase * (2 * p.b) + (1 + p.b**2)
    ) ** -1.5 * (scale * (1 - p.c))
    half_tangent = np.sqrt(2 / np.minimum(cos_phase + 1, 2) - 1)
    surge = (p.b_s0 * p.h_s) / (half_tangent + p.h_s) + 1
    return product / total * (shadowing * (p.w / 4)) * (phase * surge + multiple)


def roughness(theta_bar_deg: float, mu0: Any, mu: Any, cos_phase: Any) -> tuple[Any, Any, Any]:
    """Hapke's correction for a surface of mean slope theta_bar.

    Source: Hapke 1984, doi 10.1016/0019-1035(84)90054-X.
    Returns the effective cosines of the larger and of the smaller angle of i and e, and S / (mu0 mue). Hapke gives two
    cases, i <= e and e <= i, which differ only by exchanging the two angles. Ordering the angles by size leaves one
    case, with the same S / (mu0 mue). The formulas follow chapter 12 of Hapke's book of 2012. In this form, S exceeds 1
    at grazing angles, by at most 7 percent up to 85 degrees.
    """
    slope, chi = slope_of(theta_bar_deg), chi_of(theta_bar_deg)
    # Cosines of the larger and the smaller angle.
    cos_l, cos_s = np.minimum(mu0, mu), np.maximum(mu0, mu)
    sin_l, e1_l, e2_l = _slopes(slope, cos_l)
    sin_s, e1_s, e2_s = _slopes(slope, cos_s)
    open_l, open_s = 2 - e1_l, 2 - e1_s
    cos_psi = np.minimum(np.maximum((cos_phase - mu0 * mu) / (sin_l * sin_s), -1), 1)
    psi = np.arccos(cos_psi)
    # Hapke's f, with psi/2 slightly reduced, since the tangent of 90 degrees overflows.
    seen_as_one = np.exp(np.tan(psi * 0.499999) * -2)
    # At i = e = 90 degrees and psi = 180 degrees this denominator and the numerators are 0.
    per_both = slope / np.maximum(psi * e1_s * (-1 / np.pi) + open_l, 1e-4)
    common = (cos_psi * -0.5 + 0.5) * e2_s
    larger = sin_l * (e2_l - common) * per_both + cos_l
    smaller = sin_s * (cos_psi * e2_l + common) * per_both + cos_s
    # Hapke's eta of each angle: its effective cosine, independent of the other angle.
    alone_l = sin_l * e2_l / open_l * slope + cos_l
    alone_s = sin_s * e2_s / open_s * slope + cos_s
    # The four effective cosines above lack the factor chi, so one factor 1 / chi remains in the shadowing.
    shadowing = (1 / chi) / (alone_l * (seen_as_one * (cos_s - alone_s) + alone_s))
    return larger * chi, smaller * chi, shadowing


def slope_of(theta_bar_deg: float) -> float:
    """Tangent of the mean slope."""
    return float(np.tan(np.radians(theta_bar_deg)))


def chi_of(theta_bar_deg: float) -> float:
    """Hapke's chi: effective cosine of a vertical ray."""
    return float(1 / np.sqrt(1 + np.pi * slope_of(theta_bar_deg) ** 2))


def _slopes(slope: float, cosine: Any) -> tuple[Any, Any, Any]:
    """Sine of an angle, and Hapke's E1 and E2."""
    sine = np.sqrt(np.maximum(cosine * cosine * -1 + 1, MIN_SINE_SQUARED))
    exponent = cosine / sine * (-2 / np.pi / slope)
    return sine, np.exp(exponent), np.exp(exponent * exponent * (-np.pi / 4))


def lommel_seeliger(mu0: Any, mu: Any, cos_phase: Any) -> Any:
    """Single scattering with an isotropic phase function, I/F = w/4 mu0/(mu0+mu), w = 0.4."""
    return 0.1 / (mu0 + mu) + 0 * cos_phase


LUNAR_LAMBERT_SCALE = 0.0503
"""Scale of `lunar_lambert`, which we fitted as for `MEAN`. The ratio of the law to the published fit is 0.63 at an
incidence of 5 degrees, rises to 1.28, and is 0.89 at 80 degrees."""


def lunar_lambert(mu0: Any, mu: Any, cos_phase: Any) -> Any:
    """McEwen's lunar-Lambert law, I/F = scale [2 L mu0/(mu0+mu) + (1-L) mu0].

    L = 1 - 0.019 g + 2.42e-4 g^2 - 1.46e-6 g^3, g in degrees (McEwen 1991, doi 10.1016/0019-1035(91)90053-V). The
    polynomial is valid up to g = 104 degrees, where it falls below 0; at larger angles, L is 0. The law describes how
    brightness varies over a surface at one phase angle. Deviation: McEwen fits the scale to each image, and it falls
    with the phase angle; here the scale is constant.
    """
    g = np.arccos(np.minimum(np.maximum(cos_phase, -1), 1)) * (180 / np.pi)
    share = np.maximum(1 + g * (-0.019 + g * (2.42e-4 + g * -1.46e-6)), 0)
    return LUNAR_LAMBERT_SCALE * (2 * share / (mu0 + mu) + (1 - share))


def lambert(mu0: Any, mu: Any, cos_phase: Any) -> Any:
    """A Lambertian surface of albedo 0.12, I/F = 0.12 mu0."""
    return 0.12 + 0 * mu0 + 0 * mu + 0 * cos_phase


HAPKE = {"hapke_highland": HIGHLAND, "hapke_mare": MARE, "hapke_mean": MEAN}
"""Parameters of the laws that follow Hapke's model."""
LAWS: dict[str, Law] = {
    **{name: partial(hapke, parameters) for name, parameters in HAPKE.items()},
    "lommel_seeliger": lommel_seeliger,
    "lunar_lambert": lunar_lambert,
    "lambert": lambert,
}


def reflectance_factor(law: str, mu0: Any, mu: Any, cos_phase: Any) -> Any:
    """I/F of a named law, divided by mu0, for mu0, mu > 0; arrays broadcast.

    A diffuse shader with this value as its colour has the radiance I/F.
    """
    return LAWS[law](mu0, mu, cos_phase)


def radiance_factor(law: str, mu0: Any, mu: Any, cos_phase: Any) -> Any:
    """I/F of a named law for mu0, mu > 0; arrays broadcast."""
    return mu0 * reflectance_factor(law, mu0, mu, cos_phase)
