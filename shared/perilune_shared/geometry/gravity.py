"""Gravity at the landing site."""

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.geometry.frames import MOON_RADIUS_M, Array

MOON_GM_M3_PER_S2 = 4.902800118e12
"""Gravitational parameter of the Moon, m^3/s^2 (GRAIL, doi 10.1002/2014GL060027)."""


def gravity_mps2(height_m: ArrayLike) -> Array:
    """Return the acceleration by gravity (..., 3), O_L, m/s^2, at heights (...) above the site, metres.

    The magnitude is computed for a spherical Moon. The direction is -Z_L everywhere, as above a plane; at 2 km from the
    site the true direction differs by 0.07 degrees. The Moon's rotation (0.55 degrees per hour) is neglected.
    """
    height = np.asarray(height_m, np.float64)
    down = MOON_GM_M3_PER_S2 / (MOON_RADIUS_M + height) ** 2
    return np.stack([np.zeros_like(down), np.zeros_like(down), -down], axis=-1)
