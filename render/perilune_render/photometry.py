"""Reflectance laws of the lunar surface, written once for NumPy arrays and for Blender's shader.

Theory: a law gives the radiance factor I/F (radiance over that of a perfectly diffusing plate lit from the zenith)
from mu0 = cos incidence, mu = cos emission and cos of the phase angle. Note that the phase angle is not i + e: that
holds in the principal plane only.

Use: `radiance_factor("hapke_highland", mu0, mu, cos_phase)`. The functions use nothing but arithmetic and NumPy's
ufuncs, so that `perilune_render.blender.nodes` can hand them symbols and build shader nodes from the same text.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

Law = Callable[[Any, Any, Any], Any]


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
    """Width of the surge, radians of tan(g/2)."""


HIGHLAND = HapkeParameters(0.385, 0.2375, 0.325, 1.686, 0.0672)
"""Median of latitudes within 30 degrees of the equator, 643 nm, ascribed to Sato et al. 2014, taken second hand."""
MARE = HapkeParameters(0.222, 0.254, 0.160, 1.993, 0.0597)
"""Tranquillitatis, 643 nm, ascribed to Sato et al. 2014, taken second hand."""


def hapke(parameters: HapkeParameters, mu0: Any, mu: Any, cos_phase: Any) -> Any:
    """Hapke's radiance factor with shadow hiding and multiple scattering, without macroscopic roughness.

    I/F = w/4 mu0/(mu0+mu) [p(g) (1 + B_S0 / (1 + tan(g/2)/h_S)) + H(mu0) H(mu) - 1], H(x) = (1+2x)/(1+2x sqrt(1-w)).
    Deviation: the roughness factor S is left out here, because the terrain brings its own roughness down to the pixel.
    """
    p = parameters
    tan_half = np.sqrt(np.maximum(1 - cos_phase, 0) / np.maximum(1 + cos_phase, 1e-6))
    surge = 1 + p.b_s0 / (1 + tan_half * (1 / p.h_s))
    forward = (1 + p.b**2) - 2 * p.b * cos_phase
    backward = (1 + p.b**2) + 2 * p.b * cos_phase
    scale = (1 - p.b**2) / 2
    phase = scale * (1 + p.c) / forward**1.5 + scale * (1 - p.c) / backward**1.5
    gamma = float(np.sqrt(1 - p.w))
    h0 = (1 + 2 * mu0) / (1 + mu0 * (2 * gamma))
    h = (1 + 2 * mu) / (1 + mu * (2 * gamma))
    return p.w / 4 * mu0 / (mu0 + mu) * (phase * surge + h0 * h - 1)


def lommel_seeliger(mu0: Any, mu: Any, cos_phase: Any) -> Any:
    """Single scattering with an isotropic phase function, I/F = w/4 mu0/(mu0+mu), w = 0.4."""
    return 0.1 * mu0 / (mu0 + mu) + 0 * cos_phase


def lambert(mu0: Any, mu: Any, cos_phase: Any) -> Any:
    """An evenly diffusing surface of albedo 0.12, I/F = 0.12 mu0."""
    return 0.12 * mu0 + 0 * mu + 0 * cos_phase


LAWS: dict[str, Law] = {
    "hapke_highland": lambda mu0, mu, cos_phase: hapke(HIGHLAND, mu0, mu, cos_phase),
    "hapke_mare": lambda mu0, mu, cos_phase: hapke(MARE, mu0, mu, cos_phase),
    "lommel_seeliger": lommel_seeliger,
    "lambert": lambert,
}


def radiance_factor(law: str, mu0: Any, mu: Any, cos_phase: Any) -> Any:
    """I/F of a named law for mu0, mu > 0; arrays broadcast."""
    return LAWS[law](mu0, mu, cos_phase)
