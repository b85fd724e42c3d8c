"""Lens models of fisheye and planetary cameras: equidistant, Kannala-Brandt, unified, CAHVOR and CAHVORE.

theta is the angle between a ray and the axis O of the lens, a unit vector in O_C, and e is the unit vector normal to O
on the side of the ray. All models have the form

    t = g(theta),   r = t (c0 + c1 t^2 + c2 t^4 + ...),   d = O + r e,   x' = d_x / d_z,   y' = d_y / d_z

| model | g(theta) | c | O |
|---|---|---|---|
| equidistant | theta | 1 | z |
| kannala_brandt (k1..k4) | theta | 1, k1, k2, k3, k4 | z |
| unified (xi) | sin(theta) / (cos(theta) + xi) | 1 | z |
| cahvor (O, R) | tan(theta) | 1 + R0, R1, R2 | O |
| cahvore (O, R, E, P) | sin(P theta) / P, theta, tan(P theta) / P for P < 0, 0, > 0 | 1 + R0, R1, R2 | O |

The rays of CAHVORE do not meet in one point: the entrance pupil of a ray lies on the axis, (theta / sin(theta) - 1)
(E0 + E1 theta^2 + E2 theta^4) metres from the centre C towards the scene. Type 1 of CAHVORE is P = 1, type 2 is P = 0.
No model has rays more than 90 degrees from O.

Sources: Kannala and Brandt 2006, doi 10.1109/TPAMI.2006.153 (their radially symmetric part, as in OpenCV's fisheye);
Mei and Rives 2007, doi 10.1109/ROBOT.2007.364084 (unified, as in OpenCV's omnidir); Yakimovsky and Cunningham 1978,
Computer Graphics and Image Processing 7, 195 (CAHV); Gennery 2006, doi 10.1007/s11263-006-5168-1 (CAHVOR, CAHVORE; the
formulas agree with JPL's library cmod).
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from perilune_shared.geometry.frames import Array

_AXIS = ("o_x", "o_y", "o_z")
PARAMETERS: dict[str, tuple[str, ...]] = {
    "equidistant": (),
    "kannala_brandt": ("k1", "k2", "k3", "k4"),
    "unified": ("xi",),
    "cahvor": ("skew_px", *_AXIS, "r0", "r1", "r2"),
    "cahvore": ("skew_px", *_AXIS, "r0", "r1", "r2", "e0_m", "e1_m", "e2_m", "linearity"),
}
"""Names of the parameters of each model. `linearity` is P of CAHVORE; `skew_px` y' is added to u."""
_HALF_TURN = np.pi / 2
_EDGE = 1e-12
"""Relative tolerance at the largest angle, so that rounding does not exclude it."""
_N_TABLE = 4001
_MAX_STEPS = 30


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """A lens model with its parameters; see the module."""

    axis: Array
    """O, unit vector (3,), O_C."""
    c: Array
    """c0, c1, ... of the polynomial."""
    linearity: float
    """P of g."""
    xi: float | None
    """Parameter of the unified model; None for the others."""
    pupil_m: tuple[float, float, float]
    """E0, E1, E2, metres."""
    skew_px: float
    """Factor of y' in u, pixels."""
    fold_rad: float
    """Smallest theta at which r stops growing; infinite if r grows up to 90 degrees."""
    table: Array
    """theta, ascending up to 90 degrees or the fold, and r (2, M)."""

    @property
    def is_central(self) -> bool:
        """Whether all rays meet in one point."""
        return not any(self.pupil_m)

    def image(self, points_m: Array) -> tuple[Array, Array]:
        """x' and y' (...) of points (..., 3), O_C, metres.

        Returns NaN for points more than 90 degrees from the axis, or beyond the fold.
        """
        axial = points_m @ self.axis
        lateral = points_m - axial[..., None] * self.axis
        across = np.linalg.norm(lateral, axis=-1)
        theta = np.arctan2(across, axial)
        if not self.is_central:
            theta = self._theta_from_pupil(axial, across, theta)
        seen = (theta <= _HALF_TURN * (1 + _EDGE)) & (theta < self.fold_rad) & (across + np.abs(axial) > 0)
        with np.errstate(all="ignore"):
            r = self.radius(np.where(seen, np.minimum(theta, _HALF_TURN), np.nan))
            d = self.axis + np.where(across > 0, r / np.where(across > 0, across, 1), 0.0 * r)[..., None] * lateral
            z = np.where(d[..., 2] > 0, d[..., 2], np.nan)
            return d[..., 0] / z, d[..., 1] / z

    def directions(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Unit vectors (..., 3), O_C, of the rays to x' and y' (...), and the positions of their pupils on the axis.

        The positions (...) are metres from C. Returns NaN if no ray within 90 degrees of the axis, before the fold, has
        this image.
        """
        d = np.stack([x, y, np.ones_like(x)], axis=-1)
        axial = d @ self.axis
        lateral = d - axial[..., None] * self.axis
        across = np.linalg.norm(lateral, axis=-1)
        with np.errstate(all="ignore"):
            r = np.where(axial > 0, across / axial, np.nan)
            theta = self.angle(r)
            e = np.where(across[..., None] > 0, lateral / np.where(across > 0, across, 1)[..., None], 0.0)
            ray = np.cos(theta)[..., None] * self.axis + np.sin(theta)[..., None] * e
            return ray, self._pupil_at(theta)

    def radius(self, theta: Array) -> Array:
        """r at angles theta (...), radians."""
        t = self._g(theta)
        return t * np.polynomial.polynomial.polyval(t * t, self.c)

    def angle(self, r: Array) -> Array:
        """theta (...), radians, at radii r (...): the inverse of `radius`, NaN beyond its largest value."""
        angles, radii = self.table
        # Without an upper bound of r, the table ends just before 90 degrees.
        seen = r <= (np.inf if radii[-1] > 1e5 else radii[-1] * (1 + _EDGE))
        target = np.where(seen, np.minimum(r, radii[-1]), np.nan)
        t, largest = self._g(np.interp(target, radii, angles)), self._g(angles[-1])
        slope = self.c * (2 * np.arange(len(self.c)) + 1)
        for _ in range(_MAX_STEPS):
            off = target - t * np.polynomial.polynomial.polyval(t * t, self.c)
            after = np.clip(t + off / np.polynomial.polynomial.polyval(t * t, slope), 0, largest)
            still = not (np.abs(after - t) > 1e-15 * after).any()
            t = after
            if still:
                break
        return self._inverse_of_g(t)

    def _g(self, theta: Array) -> Array:
        if self.xi is not None:
            return np.sin(theta) / (np.cos(theta) + self.xi)
        p = self.linearity
        if p == 0:
            return theta
        return np.tan(p * theta) / p if p > 0 else np.sin(p * theta) / p

    def _inverse_of_g(self, t: Array) -> Array:
        if self.xi is not None:
            # The unit sphere is met at eta (t, 1) - (0, xi).
            eta = (self.xi + np.sqrt(np.maximum(1 + (1 - self.xi**2) * t * t, 0))) / (1 + t * t)
            return np.arctan2(eta * t, eta - self.xi)
        p = self.linearity
        if p == 0:
            return t
        return np.arctan(p * t) / p if p > 0 else np.arcsin(np.maximum(p * t, -1)) / p

    def _pupil_at(self, theta: Array) -> Array:
        """Distance of the pupil from C, metres, at angles theta (...)."""
        if self.is_central:
            return np.zeros_like(theta)
        square = theta * theta
        away = np.where(square < 1e-8, square / 6, theta / np.where(square < 1e-8, 1, np.sin(theta)) - 1)
        return away * np.polynomial.polynomial.polyval(square, self.pupil_m)

    def _theta_from_pupil(self, axial: Array, across: Array, theta: Array) -> Array:
        """theta (...) of the rays from the moving pupil to points, `axial` along O and `across` from it, metres.

        Newton's method on axial sin(theta) - across cos(theta) = (theta - sin(theta)) E(theta), starting from the angle
        seen from C. NaN if it does not converge, for points as near as the pupil moves.
        """
        e0, e1, e2 = self.pupil_m
        near = np.hypot(axial, across)
        for _ in range(_MAX_STEPS):
            sin, cos, square = np.sin(theta), np.cos(theta), theta * theta
            pupil, slope = e0 + square * (e1 + square * e2), theta * (2 * e1 + 4 * square * e2)
            off = axial * sin - across * cos - (theta - sin) * pupil
            if not (np.abs(off) > 1e-15 * near).any():
                break
            with np.errstate(all="ignore"):
                theta = theta - off / (axial * cos + across * sin - (1 - cos) * pupil - (theta - sin) * slope)
        return np.where(np.abs(off) <= 1e-12 * near, theta, np.nan)


@lru_cache(maxsize=64)
def lens_of(model: str, parameters: tuple[float, ...]) -> Lens:
    """The lens of a model with the parameters in the order of `PARAMETERS`.

    Raises ValueError on an unknown model, a wrong number of parameters, or parameters out of range.
    """
    if model not in PARAMETERS or len(parameters) != len(PARAMETERS[model]):
        raise ValueError(f"{len(parameters)} parameters of the lens model {model}")
    value = dict(zip(PARAMETERS[model], parameters, strict=True))
    axis, linearity = np.array([0.0, 0.0, 1.0]), 0.0
    c: tuple[float, ...] = (1.0,)
    if model == "kannala_brandt":
        c = (1.0, *parameters)
    if model in ("cahvor", "cahvore"):
        axis = np.array([value[name] for name in _AXIS])
        with np.errstate(all="ignore"):
            axis, linearity = axis / np.linalg.norm(axis), value.get("linearity", 1.0)
        c = (1.0 + value["r0"], value["r1"], value["r2"])
    if not np.isfinite(axis).all() or not -1 <= linearity <= 1 or value.get("xi", 0.0) < 0:
        raise ValueError("an axis O that is not 0, linearity from -1 to 1, and xi of at least 0")
    pupil = value.get("e0_m", 0.0), value.get("e1_m", 0.0), value.get("e2_m", 0.0)
    skew_px, unknown = value.get("skew_px", 0.0), np.zeros((2, 1))
    lens = Lens(axis, np.array(c), linearity, value.get("xi"), pupil, skew_px, np.inf, unknown)
    # tan and, without xi, the unified model have no image at 90 degrees.
    unbounded = linearity == 1 if lens.xi is None else lens.xi == 0
    end = _HALF_TURN - 1e-7 if unbounded else _HALF_TURN
    fold = _fold_rad(lens, end)
    angles = np.linspace(0, min(fold, end), _N_TABLE)
    with np.errstate(all="ignore"):
        return replace(lens, fold_rad=fold, table=np.stack([angles, lens.radius(angles)]))


def _fold_rad(lens: Lens, end_rad: float) -> float:
    """Smallest theta up to `end_rad` at which dr/dt = c0 + 3 c1 t^2 + 5 c2 t^4 + ... is not positive, or infinity."""
    slope = lens.c * (2 * np.arange(len(lens.c)) + 1)

    def grows(theta: Array) -> Array:
        return np.polynomial.polynomial.polyval(np.square(lens._g(theta)), slope) > 0

    with np.errstate(all="ignore"):
        angles = np.linspace(0, end_rad, _N_TABLE)
        first = int(np.argmin(grows(angles)))
        if grows(angles[first]):
            return np.inf
        low, high = angles[max(first - 1, 0)], angles[first]
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if grows(middle) else (low, middle)
    return float(high)
