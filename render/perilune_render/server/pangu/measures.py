"""Answer PANGU's messages that measure heights, points and ranges.

A ray that begins below the surface or meets the back of a facet counts as a miss.
"""

import numpy as np

from perilune_render.server.pangu import messages as m
from perilune_render.server.pangu.session import Session, check_camera, picture
from perilune_render.server.pangu.view import rotation_from_quaternion
from perilune_render.server.pangu.wire import float_array, float_bytes, unsigned
from perilune_render.server.simulation import SimulatedScene
from perilune_shared.geometry.frames import Array

RANGE_WIDTH = 256
"""Number of pixels of the range texture, one for each grey value."""
_MAX_HEIGHTS = 1_000_000


def seen(
    simulated: SimulatedScene, origins_m: Array, directions: Array, *, boulders: bool = True
) -> tuple[Array, Array]:
    """Distances (N,) and cosines of incidence (N,) of rays from positions (1 or N, 3) along directions (N, 3).

    A distance is a multiple of its direction's length. A miss has infinite distance and cosine 0. Raises ValueError for
    a direction of length 0.
    """
    length = np.linalg.norm(directions, axis=1)
    if (length == 0).any():
        raise ValueError("a direction of length 0")
    surface_m = simulated.heights_m(origins_m[:, 0], origins_m[:, 1], boulders=boulders)
    under = origins_m[:, 2] < surface_m  # false beyond the edge of the ground, where the surface is NaN
    origins = np.broadcast_to(origins_m, directions.shape)
    distance, normal = simulated.hits(origins, directions, boulders=boulders)
    cosine = -np.einsum("ij,ij->i", normal, directions) / length
    front = np.isfinite(distance) & ~under & (cosine > 0)
    return np.where(front, distance, np.inf), np.where(front, cosine, 0.0)


def elevations(session: Session, places_m: Array) -> Array:
    """Heights (N,) of positions (N, 3) above the surface, metres; infinite without a surface below a position."""
    distance, _ = seen(session.simulated, places_m, np.tile([0.0, 0.0, -1.0], (len(places_m), 1)))
    return distance


def points(session: Session, directions: Array) -> Array:
    """Points (N, 3) of the surface that the camera sees in directions (N, 3), O_L; not finite without a hit."""
    distance, _ = seen(session.simulated, session.position_m[None], directions)
    with np.errstate(invalid="ignore"):
        return session.position_m + distance[:, None] * directions


def looked_up(session: Session, places: Array) -> Array:
    """Points (N, 3) of the surface seen at image positions (N, 2); not finite without a hit or outside the image.

    Position (0, 0) is the bottom left corner of the image, (1, 1) the top right corner.
    """
    view = session.view()
    pixels = np.stack([places[:, 0] * session.width_px, (1 - places[:, 1]) * session.height_px], axis=1)
    hits = points(session, view.camera.rays(pixels) @ view.rotation_camera_from_site)
    outside = ((places < 0) | (places > 1)).any(axis=1)
    return np.where(outside[:, None], np.inf, hits)


def pulse(session: Session, values: list, items: object) -> bytes:
    """Answer to GetLidarPulseResult: range and cosine of incidence, both 0 for a miss."""
    origin, direction = np.array([values[:3]]), np.array([values[3:]])
    distance, cosine = seen(session.simulated, origin, direction)
    range_m = distance[0] * np.linalg.norm(direction) if np.isfinite(distance[0]) else 0.0
    return unsigned(m.LIDAR_PULSE) + float_bytes([range_m, cosine[0]])


def surface(session: Session, boulders: bool, places_m: Array) -> Array:
    """Heights (N,) of the surface at positions (N, 2); NaN beyond the edge of the ground."""
    return session.simulated.heights_m(places_m[:, 0], places_m[:, 1], boulders=boulders)


def _grid(nx: int, ny: int, dx: float, dy: float) -> tuple[Array, Array]:
    """Positions (ny, nx) on a grid around 0. Raises ValueError if the grid is empty or too large."""
    if not 1 <= nx * ny <= _MAX_HEIGHTS:
        raise ValueError(f"{nx} x {ny} heights, expected 1 to {_MAX_HEIGHTS}")
    x, y = np.meshgrid((np.arange(nx) - (nx - 1) / 2) * dx, (np.arange(ny) - (ny - 1) / 2) * dy)
    return x, y


def patch(session: Session, values: list, items: object) -> bytes:
    """Answer to GetSurfacePatch: heights on a grid rotated about its centre."""
    boulders, cx, cy, nx, ny, spacing, angle = values
    x, y = _grid(nx, ny, spacing, spacing)
    c, s = np.cos(angle), np.sin(angle)
    grid = np.stack([cx + c * x - s * y, cy + s * x + c * y], axis=-1).reshape(-1, 2)
    return float_array(surface(session, boulders, grid))


def view_as_dem(session: Session, values: list, items: object) -> bytes:
    """Answer to GetViewAsDEM: heights along the camera's axis, on a grid perpendicular to the axis."""
    camera, boulders, nx, ny, dx, dy, reference = values
    if camera != 1:
        raise ValueError(f"camera {camera}, expected 1")
    x, y = _grid(nx, ny, dx, -dy)
    across, down, forward = session.rotation_camera_from_site
    origins = session.position_m + x[..., None] * across - y[..., None] * down
    distance, _ = seen(session.simulated, origins.reshape(-1, 3), np.tile(forward, (nx * ny, 1)), boulders=boulders)
    return float_array(reference - distance)


def range_image(session: Session, values: list, items: object) -> bytes:
    """Answer to GetRangeImage: an image whose grey values are scaled ranges."""
    offset, scale = values
    view = session.view()
    depth_m = session.simulated.radiance(view).depth_m
    ranges = depth_m * np.linalg.norm(view.camera.rays(view.camera.pixel_centres()), axis=-1)
    share = np.clip((ranges - offset) * scale, 0, 1) if scale else np.zeros_like(ranges)
    return picture(np.floor(share * (RANGE_WIDTH - 1) + 0.5).astype(np.uint8))


def range_texture(session: Session, values: list, items: object) -> bytes:
    """Answer to GetRangeTexture: one row of pixels with the grey values 0 to 255."""
    return picture(np.arange(RANGE_WIDTH, dtype=np.uint8)[None])


def snapshot(session: Session, values: list, items: object) -> bytes:
    """Answer to GetLidarSnapshot: range, cosine of incidence and hit of each pixel.

    Raises UserError if the camera is not above the surface.
    """
    check_camera(values[0])
    position, rotation = np.array(values[1:4]), rotation_from_quaternion(np.array(values[4:]))
    session.simulated.check(position)
    camera = session.view().camera
    rays = camera.rays(camera.pixel_centres()).reshape(-1, 3) @ rotation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance, cosine = seen(session.simulated, position[None], rays)
    hit = np.isfinite(distance)
    data = np.stack([np.where(hit, distance, 0.0), cosine, hit], axis=1).astype(">f4").tobytes()
    return unsigned(m.RAW_IMAGE, 0, 0, camera.width_px, camera.height_px, len(data)) + data
