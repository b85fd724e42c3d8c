"""Frames of reference and rotations.

Names follow the section "Coordinates" of the paper by Song et al. (cited in README.md):

- O_S selenographic: latitude (north positive) and longitude (east positive) on a sphere of the IAU mean radius.
- O_L landing site: origin at the ideal landing point, Z up, Y towards the Moon's south pole, X west
  (right-handed).
- O_W world: axes of O_L, origin at the lander's first position.
- O_B body: fixed to the lander.
- O_C camera: OpenCV axes, x right, y down, z along the viewing direction.

A rotation is named `rotation_<to>_from_<from>` and acts on column vectors: v_to = R v_from. A quaternion (w, x, y, z)
has length 1 and represents such a matrix.

The functions do not use SciPy's `Rotation`: its results differ in the last bits (by up to 1.2e-15, for 92 to 99.9 % of
random rotations), which would change poses and labels of datasets. The tests compare both.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

MOON_RADIUS_M = 1_737_400.0
"""Mean radius of the Moon, IAU Working Group report 2015 (doi 10.1007/s10569-017-9805-5)."""

Array = NDArray[np.float64]


def matrix_from_quaternion(rotation_wxyz: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4), which are normalised first."""
    q = np.asarray(rotation_wxyz, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(rotation: ArrayLike) -> Array:
    """Return the quaternion (4,) with w >= 0 of a rotation matrix (3, 3).

    It is computed as an eigenvector (Bar-Itzhack 2000, doi 10.2514/2.4654), which is accurate for all rotations,
    including those by 180 degrees.
    """
    r = np.asarray(rotation, dtype=np.float64)
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0, r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [0, 0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [0, 0, 0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    q = np.linalg.eigh(k, UPLO="U")[1][:, -1]
    return q if q[0] >= 0 else -q


def matrix_from_rotation_vector(rotation_vector_rad: ArrayLike) -> Array:
    """Return the matrix (3, 3) that rotates by |v| radians about v (3,) (Rodrigues' formula)."""
    v = np.asarray(rotation_vector_rad, dtype=np.float64)
    angle = float(np.linalg.norm(v))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = v / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def rotation_vectors(rotation: ArrayLike) -> Array:
    """Return the rotation vectors (..., 3), radians, of rotation matrices (..., 3, 3).

    Use it for angles well below 180 degrees. The angle is computed from sine and cosine, since the arc cosine alone is
    inexact for small angles.
    """
    r = np.asarray(rotation, np.float64)
    skew = r - np.swapaxes(r, -1, -2)
    twice_sine = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    length = np.linalg.norm(twice_sine, axis=-1, keepdims=True)
    angle = np.arctan2(length, np.trace(r, axis1=-2, axis2=-1)[..., None] - 1)
    return twice_sine * np.where(length > 1e-12, angle / np.where(length > 1e-12, length, 1), 0.5)


def sun_direction(azimuth_deg: float, elevation_deg: float) -> Array:
    """Return the unit vector (3,), O_L, towards the Sun; the azimuth is clockwise from north."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    east, north = np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation)
    return np.array([-east, -north, np.sin(elevation)])


def earth_direction(latitude_deg: float, longitude_deg: float) -> Array:
    """Return the unit vector (3,), O_L, from a site towards the mean position of the Earth.

    The Earth is on average above latitude 0, longitude 0. Libration (up to about 8 degrees) and the parallax of the
    site (up to 0.3 degrees) are neglected.
    """
    latitude, longitude = np.radians([latitude_deg, longitude_deg])
    west, south = np.sin(longitude), np.sin(latitude) * np.cos(longitude)
    return np.array([west, south, np.cos(latitude) * np.cos(longitude)])


def selenographic_from_site(
    x_m: ArrayLike, y_m: ArrayLike, latitude_deg: float, longitude_deg: float
) -> tuple[Array, Array]:
    """Convert x and y in O_L, metres, to latitude and longitude, degrees.

    Inverse of `site_from_selenographic`; the site is at (latitude_deg, longitude_deg). The projection is azimuthal
    equidistant: it preserves distance and bearing from the site. At a pole, "towards the south pole"
    does not define Y: there, the meridian longitude_deg leaves the site along +Y (north pole) or -Y (south pole).
    """
    west, south = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
    distance = np.hypot(west, south)
    angle = distance / MOON_RADIUS_M
    safe = np.where(distance > 0, distance, 1.0)
    north_share, east_share = -south / safe, -west / safe
    lat0, lon0 = np.radians([latitude_deg, longitude_deg])
    sin_lat = np.cos(angle) * np.sin(lat0) + np.sin(angle) * np.cos(lat0) * north_share
    latitude = np.arcsin(np.clip(sin_lat, -1, 1))
    longitude = lon0 + np.arctan2(
        np.sin(angle) * east_share,
        np.cos(lat0) * np.cos(angle) - np.sin(lat0) * np.sin(angle) * north_share,
    )
    return np.degrees(latitude), (np.degrees(longitude) + 180) % 360 - 180


def site_from_selenographic(
    point_latitude_deg: ArrayLike, point_longitude_deg: ArrayLike, latitude_deg: float, longitude_deg: float
) -> tuple[Array, Array]:
    """Convert latitudes and longitudes, degrees, to x and y in O_L, metres.

    Inverse of `selenographic_from_site`; the site is at (latitude_deg, longitude_deg).
    """
    lat, lon = (
        np.radians(np.asarray(point_latitude_deg, np.float64)),
        np.radians(np.asarray(point_longitude_deg, np.float64)),
    )
    lat0, lon0 = np.radians([latitude_deg, longitude_deg])
    east = np.cos(lat) * np.sin(lon - lon0)
    north = np.cos(lat0) * np.sin(lat) - np.sin(lat0) * np.cos(lat) * np.cos(lon - lon0)
    up = np.sin(lat0) * np.sin(lat) + np.cos(lat0) * np.cos(lat) * np.cos(lon - lon0)
    sine = np.hypot(east, north)
    scale = MOON_RADIUS_M * np.arctan2(sine, up) / np.where(sine > 0, sine, 1.0)
    return -east * scale, -north * scale
