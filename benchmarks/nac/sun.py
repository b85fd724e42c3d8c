"""Position of the Sun for a Narrow Angle Camera image, computed from its product number alone.

The digits after the M of a product name count seconds of the spacecraft clock; ten-digit numbers that begin with 1
continue the nine-digit ones. Only the largest terms of the Sun's and the Moon's motion are used (Meeus, Astronomical
Algorithms, chapters 25, 47 and 53): the Sun's position is accurate to a few tenths of a degree.
"""

import re
from datetime import datetime, timedelta

import numpy as np

_CLOCK = 128963531, datetime(2010, 5, 20, 2, 57, 44)
"""Clock number and start time of M128963531, from its label."""
_MOON_LONGITUDE = (
    (6.288774, 0, 0, 1, 0), (1.274027, 2, 0, -1, 0), (0.658314, 2, 0, 0, 0), (0.213618, 0, 0, 2, 0),
    (-0.185116, 0, 1, 0, 0), (-0.114332, 0, 0, 0, 2), (0.058793, 2, 0, -2, 0), (0.057066, 2, -1, -1, 0),
)  # fmt: skip
"""Amplitude in degrees; multiples of the elongation, of the anomalies of Sun and Moon, and of the node's distance."""
_INCLINATION_DEG = 1.54242
_MOON_OVER_SUN = 1 / 389
"""Ratio of the mean distances from the Earth."""


def time_of(name: str) -> datetime | None:
    """Start (UTC) of the image whose name begins with a product number; None for other names."""
    found = re.match(r"M(1\d{8,9})(?!\d)", name)
    if found is None:
        return None
    number = int(found[1])
    seconds = number if number < 10**9 else number - 9 * 10**8
    return _CLOCK[1] + timedelta(seconds=seconds - _CLOCK[0])


def subsolar_point(time: datetime) -> tuple[float, float]:
    """Latitude and longitude, degrees, of the subsolar point on the Moon; longitude -180 to 180."""
    century = ((time - datetime(2000, 1, 1, 12)).total_seconds() + 67) / 86400 / 36525
    anomaly = 357.52911 + 35999.05029 * century
    sun = 280.46646 + 36000.76983 * century + 1.914602 * _sin(anomaly) + 0.019993 * _sin(2 * anomaly)
    elongation = 297.8501921 + 445267.1114034 * century
    moon_anomaly = 134.9633964 + 477198.8675055 * century
    from_node = 93.2720950 + 483202.0175233 * century
    angles = elongation, anomaly, moon_anomaly, from_node
    moon = 218.3164477 + 481267.88123421 * century
    moon += sum(term[0] * _sin(np.dot(term[1:], angles)) for term in _MOON_LONGITUDE)
    moon_latitude = 5.128 * _sin(from_node)
    # Coordinates of the Moon seen from the Sun.
    longitude = sun + 180 + np.degrees(_MOON_OVER_SUN) * _cos(moon_latitude) * _sin(sun - moon)
    latitude = _MOON_OVER_SUN * moon_latitude
    w = longitude - (125.0445479 - 1934.1362891 * century)
    tilt = _INCLINATION_DEG
    along = np.degrees(
        np.arctan2(
            _sin(w) * _cos(latitude) * _cos(tilt) - _sin(latitude) * _sin(tilt),
            _cos(w) * _cos(latitude),
        )
    )
    north = np.degrees(np.arcsin(-_sin(w) * _cos(latitude) * _sin(tilt) - _sin(latitude) * _cos(tilt)))
    return float(north), float((along - from_node + 180) % 360 - 180)


def sun_over(latitude_deg: float, longitude_deg: float, time: datetime) -> tuple[float, float]:
    """Azimuth (clockwise from north) and elevation of the Sun at a place on the Moon, degrees."""
    sun_latitude, sun_longitude = subsolar_point(time)
    hour = longitude_deg - sun_longitude
    up = _sin(latitude_deg) * _sin(sun_latitude) + _cos(latitude_deg) * _cos(sun_latitude) * _cos(hour)
    east = -_cos(sun_latitude) * _sin(hour)
    north = _cos(latitude_deg) * _sin(sun_latitude) - _sin(latitude_deg) * _cos(sun_latitude) * _cos(hour)
    return float(np.degrees(np.arctan2(east, north)) % 360), float(np.degrees(np.arctan2(up, np.hypot(east, north))))


def _sin(degrees: float) -> float:
    return float(np.sin(np.radians(degrees)))


def _cos(degrees: float) -> float:
    return float(np.cos(np.radians(degrees)))
