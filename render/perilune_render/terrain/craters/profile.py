"""Crater profiles, fresh and worn, as tables over distance and wear.

R is the radius of a crater, r the distance from its centre, and x = r/R. A fresh profile is h = h_rim rim(x) + d
bowl(x), with the rim height h_rim and the depth d. `rim` describes rim and ejecta, with height 1 at the crest; `bowl`
is a bowl of depth 1 below the crest. Both have continuous slopes everywhere, since a kink at the crest or at the end of
the ejecta blanket would render as a ring.

- `fassett_thomson`: Fassett & Thomson 2014, eq. 4 (doi 10.1002/2014JE004698). Deviations: the outer polynomial is
  scaled by 13 % to meet the crest (as printed, it leaves a step of 0.004 D). The crest and the end of the
  blanket are rounded by cubics; in the source the crest is flat, and the blanket ends at x = 1.5 with a slope. The bowl
  is scaled to the given depth, and a soft minimum rounds its floor, which is cut flat in the source. With `flat`, the
  floor is flat and has a soft edge.
- `pangu`: a parabolic bowl, a cubic flank and ejecta that thin as x^-3, as in the simulator PANGU (Martin, Parkes &
  Dunstan 2014, doi 10.1109/TAES.2014.120282). Deviations: its printed constants beta and h3 are not used, since they
  give unrealistic shapes; the crest is rounded, and the ejecta end at REACH.

Wear: topographic diffusion dh/dt = kappa laplacian h (Fassett & Thomson), solved exactly on a radial grid. In x = r/R
the solution depends only on K/R^2, where K = kappa t. The profile is linear in h_rim and d, and diffusion is linear, so
one table for each part serves all craters. Another table gives the share of the older ground that the crater has
removed. This share diffuses too, so that its edge widens with wear and leaves no ridge. A bowl is steeper than its
flank, so wear moves the crest outwards. The table `crest` gives the radius of the crest, so that stamping can place the
current crest on the circle of the label.
"""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from perilune_shared.geometry.frames import Array

REACH = 3.0
"""Distance at which profiles end, in crater radii."""
DEPTH_OVER_RIM = np.linspace(1.5, 9.0, 16)
"""Ratios of fresh depth to fresh rim height for which the crest's radius is tabulated."""
_FARTHEST_CREST = 1.5
"""Largest radius of a worn crest, in radii of the fresh crater."""
_DOMAIN, _N_RADIAL = 6.0, 600
"""Radius, in crater radii, of the grid on which diffusion is solved, and the number of its cells."""
_CREST = 0.036822
"""Height of Fassett & Thomson's inner polynomial at x = 0.98, where the crest begins, divided by the diameter."""
MIN_WEAR, MAX_WEAR, N_WEAR = 2e-4, 0.6, 56
"""Smallest and largest wear K/R^2 in the tables, and the number of rows."""


@dataclass(frozen=True, slots=True)
class ProfileTables:
    """Tables of profiles over wear and distance.

    Rows are wear, evenly spaced in log K/R^2. Columns are distance, evenly spaced in x from 0 to REACH.
    """

    rim: Array
    """Height of rim and ejecta relative to the fresh rim height (N_WEAR, n_x)."""
    bowl: Array
    """Height of the bowl, at most 0, relative to the fresh depth (N_WEAR, n_x)."""
    flat_bowl: Array
    """`bowl` of a crater with a flat floor (N_WEAR, n_x)."""
    removed: Array
    """Share of the older ground that is removed (N_WEAR, n_x)."""
    crest: Array
    """Radius of the worn crest divided by the fresh radius, for each DEPTH_OVER_RIM (N_WEAR, len(DEPTH_OVER_RIM))."""


def fresh_rim(x: Array, profile: str = "fassett_thomson") -> Array:
    """Height of the fresh rim and ejecta at x = r/R, relative to the crest; 1 inside the crest."""
    x = np.asarray(x, np.float64)
    if profile == "pangu":
        flank = _cubic(x, _End(1.0, 1.0, 0.0), _End(1.5, 1.5**-3, -3 * 1.5**-4))
        far = _cubic(x, _End(2.2, 2.2**-3, -3 * 2.2**-4), _End(REACH, 0.0, 0.0))
        return np.select([x <= 1, x < 1.5, x < 2.2, x < REACH], [np.ones_like(x), flank, np.maximum(x, 1) ** -3.0, far])
    scale = 1 / _outer(1.02)
    flank = _cubic(x, _End(1.0, 1.0, 0.0), _End(1.08, scale * _outer(1.08), scale * _outer_slope(1.08)))
    tail = _cubic(x, _End(1.4, scale * _outer(1.4), scale * _outer_slope(1.4)), _End(1.6, 0.0, 0.0))
    return np.select([x <= 1, x < 1.08, x < 1.4, x < 1.6], [np.ones_like(x), flank, scale * _outer(x), tail])


def fresh_bowl(x: Array, profile: str = "fassett_thomson", *, flat: bool = False) -> Array:
    """Height of the fresh bowl at x = r/R, relative to the depth: -1 at the centre, 0 beyond the crest."""
    x = np.asarray(x, np.float64)
    deepest = _depth_below_crest(np.zeros(1), profile, flat)
    inside = -_depth_below_crest(x, profile, flat) / deepest
    edge = 0.94
    step = 1e-5
    value, after = (
        float(-_depth_below_crest(np.array([at]), profile, flat)[0] / deepest[0]) for at in (edge, edge + step)
    )
    lip = _cubic(x, _End(edge, value, (after - value) / step), _End(1.0, 0.0, 0.0))
    return np.select([x < edge, x < 1], [inside, lip])


def _outer(x: Any) -> Any:
    return 0.188253307 - 0.187050452 * x + 0.01844746 * x**2 + 0.01505647 * x**3


def _outer_slope(x: float) -> float:
    return -0.187050452 + 2 * 0.01844746 * x + 3 * 0.01505647 * x**2


class _End(NamedTuple):
    """One end of a cubic."""

    x: float
    """Distance from the crater's centre, in crater radii."""
    value: float
    """Value at x."""
    slope: float
    """Slope at x."""


def _cubic(x: Array, low: _End, high: _End) -> Array:
    """The Hermite cubic with the given values and slopes at both ends; constant beyond them."""
    width = high.x - low.x
    t = np.clip((x - low.x) / width, 0, 1)
    return (
        (2 * t**3 - 3 * t**2 + 1) * low.value
        + (t**3 - 2 * t**2 + t) * width * low.slope
        + (3 * t**2 - 2 * t**3) * high.value
        + (t**3 - t**2) * width * high.slope
    )


def _depth_below_crest(x: Array, profile: str, flat: bool) -> Array:
    """Depth below the crest, before it is scaled to 1 at the centre."""
    inner = np.clip(x, 0, 0.98)
    if profile == "pangu":
        shape = 1 - inner**2
        if not flat:
            return shape
    else:
        polynomial = -0.228809953 + 0.227533882 * inner + 0.083116795 * inner**2 - 0.039499407 * inner**3
        shape = (_CREST - polynomial) / (_CREST + 0.228809953)
    steep, soft = (1.2, 0.1) if not flat else (1.35, 0.07) if profile == "pangu" else (1.9, 0.07)
    return soft * (np.logaddexp(0, 1 / soft) - np.logaddexp(0, (1 - steep * shape) / soft))


def fresh_depth_m(diameter_m: Array, law: str = "stopar") -> Array:
    """Depth of a newly formed crater from rim to floor, metres.

    `stopar`: Stopar et al. 2017. The source gives d/D in steps: 0.21 from 400 m, then 0.17, 0.15, and 0.13 from 40 m.
    Below 40 m we extrapolate with 0.11 and 0.10. Between the middles of the steps, d/D is interpolated linearly in log
    D.
    `pike`: Pike 1977, 0.196 D^1.01 km with D in km; derived from larger craters.
    """
    d = np.asarray(diameter_m, np.float64)
    if law == "pike":
        return 196 * (d / 1000) ** 1.01
    return d * np.interp(np.log10(d), np.log10([5, 20, 63, 141, 283, 500]), [0.10, 0.11, 0.13, 0.15, 0.17, 0.21])


def fresh_rim_height_m(diameter_m: Array, depth_m: Array, profile: str = "fassett_thomson") -> Array:
    """Height of the crest above the plain around a newly formed crater, metres.

    `fassett_thomson`: 0.184 of the depth, the ratio of Pike's rim height to Pike's depth. At 1 km this gives 0.0368 D,
    as in the source. A rim of 0.0368 D at all sizes would be too high for small, shallow craters.
    `pangu`: the smaller of two values: the ejecta's thickness at the rim, 0.14 R^0.74 (McGetchin et al. 1973), and
    Pike's rim height, 0.036 D^1.014 km with D in km.
    """
    if profile == "pangu":
        d = np.asarray(diameter_m, np.float64)
        return np.minimum(0.14 * (d / 2) ** 0.74, 36 * (d / 1000) ** 1.014)
    return 0.184 * np.asarray(depth_m, np.float64)


@functools.cache
def profile_tables(profile: str = "fassett_thomson") -> ProfileTables:
    """The tables of a profile; cached."""
    step = _DOMAIN / _N_RADIAL
    x = (np.arange(_N_RADIAL) + 0.5) * step
    edges = np.arange(1, _N_RADIAL) * step
    # Finite volumes: scaling by the square root of each ring's area makes the operator symmetric.
    flow = edges / step
    diagonal = np.zeros(_N_RADIAL)
    diagonal[:-1] -= flow
    diagonal[1:] -= flow
    area = x * step
    root = np.sqrt(area)
    operator = (
        np.diag(diagonal / area)
        + np.diag(flow / (root[:-1] * root[1:]), 1)
        + np.diag(flow / (root[:-1] * root[1:]), -1)
    )
    rates, modes = np.linalg.eigh(operator)
    wear = np.geomspace(MIN_WEAR, MAX_WEAR, N_WEAR)
    decay = np.exp(rates[None, :] * wear[:, None])
    columns = np.linspace(0, REACH, 301)
    taper = np.clip((REACH - columns) / 0.5, 0, 1)
    taper = taper * taper * (3 - 2 * taper)

    def worn(fresh: Array) -> Array:
        amplitudes = modes.T @ (fresh * root)
        rows = (decay * amplitudes) @ modes.T / root
        return np.array([np.interp(columns, x, row) for row in rows], np.float64) * taper

    rim, bowl = worn(fresh_rim(x, profile)), worn(fresh_bowl(x, profile))
    return ProfileTables(
        rim,
        bowl,
        worn(fresh_bowl(x, profile, flat=True)),
        worn(_cubic(x, _End(1.0, 1.0, 0.0), _End(1.2, 0.0, 0.0))),
        _crests(columns, rim, bowl),
    )


def _crests(x: Array, rim: Array, bowl: Array) -> Array:
    """Radius of the highest point of the profile, for each wear and each of DEPTH_OVER_RIM.

    Refined by a parabola through three columns.
    """
    shape = rim[:, None] + DEPTH_OVER_RIM[None, :, None] * bowl[:, None]
    top = np.clip(shape.argmax(axis=2), 1, len(x) - 2)
    left, here, right = (np.take_along_axis(shape, (top + k)[..., None], axis=2)[..., 0] for k in (-1, 0, 1))
    bend = left - 2 * here + right
    crest = x[top] + np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, 1), 0) * (x[1] - x[0])
    return np.clip(crest, 1.0, _FARTHEST_CREST)


def crest_radius(wear: Array, depth_over_rim: Array, profile: str = "fassett_thomson") -> Array:
    """Crest radius of craters divided by their fresh radius (N,).

    `wear` is K/R^2, `depth_over_rim` the ratio of fresh depth to fresh rim height, (N,) each. The result is limited to
    1.5, since at larger values hardly any crest remains.
    """
    tables = profile_tables(profile)
    row = wear_row(wear)
    column = np.interp(depth_over_rim, DEPTH_OVER_RIM, np.arange(len(DEPTH_OVER_RIM)))
    return ndimage.map_coordinates(tables.crest, [row, column], order=1, mode="nearest")


def wear_row(wear: Array) -> Array:
    """Fractional row of wear K/R^2 in the tables."""
    within = np.clip(wear, MIN_WEAR, MAX_WEAR)
    return np.log(within / MIN_WEAR) / np.log(MAX_WEAR / MIN_WEAR) * (N_WEAR - 1)
