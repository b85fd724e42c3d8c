"""The picture of a site map: shaded relief, site, ground tracks, scale bar, compass and legend."""

from collections.abc import Sequence

import cv2
import numpy as np

from perilune_render.flight.plan import ScenePlan
from perilune_render.preview.site_horizon import SiteHorizon
from perilune_render.preview.site_map import SiteMap
from perilune_shared.geometry.frames import Array

Colour = tuple[int, int, int]
_PAPER, _INK, _FAINT = (250, 250, 250), (30, 30, 30), (120, 120, 120)
_SITE, _TRACK, _OUTLINE, _GROUND = (60, 60, 255), (40, 160, 255), (230, 190, 60), (120, 230, 120)
"""Colours of the site, ground tracks, outline of the elevation model and extent of the ground, BGR."""
_UNKNOWN = (150, 150, 150)
_SHADOW = np.array([52.0, 30.0, 22.0])
_MAP_PX, _EDGE_PX, _LEGEND_PX = 900, 20, 320
_SHIFT = 4
"""Number of fractional bits in the coordinates of lines that OpenCV draws."""


def map_picture(
    name: str,
    site_map: SiteMap,
    plan: ScenePlan,
    place_deg: tuple[float, float],
    tracks: Sequence[Array],
    horizon: SiteHorizon,
) -> np.ndarray:
    """The picture of a site map (h, w, 3) uint8, BGR, north up.

    `place_deg` are latitude and longitude of the site. Each element of `tracks` holds the positions (N, 2 or more) of a
    trajectory in O_L, metres, in the order of its frames.
    """
    relief = cv2.resize(_shaded(site_map), (_MAP_PX, _MAP_PX), interpolation=cv2.INTER_AREA)
    _draw_square(relief, site_map)
    if site_map.outline_m is not None:
        _draw_line(relief, site_map, site_map.outline_m, _OUTLINE, closed=True)
    for track in tracks:
        _draw_line(relief, site_map, track[:, :2], _TRACK)
        u, v = _pixels(site_map, track[:1, :2])[0]
        cv2.circle(relief, (round(u), round(v)), 4, _TRACK, -1, cv2.LINE_AA)
    _draw_site(relief, *_pixels(site_map, np.zeros((1, 2)))[0])
    _draw_scale(relief, 2 * site_map.half_width_m / _MAP_PX)
    picture = np.full((_MAP_PX + 2 * _EDGE_PX, _MAP_PX + 3 * _EDGE_PX + _LEGEND_PX, 3), _PAPER, np.uint8)
    picture[_EDGE_PX : _EDGE_PX + _MAP_PX, _EDGE_PX : _EDGE_PX + _MAP_PX] = relief
    facts = _facts(site_map, plan, place_deg, horizon)
    _draw_legend(picture, name, facts, site_map, plan.sun_azimuth_deg, len(tracks))
    return picture


def _shaded(site_map: SiteMap) -> np.ndarray:
    """Grey relief where the Sun shines, dark blue shadows, plain grey where no heights are known."""
    known, lit = np.isfinite(site_map.height_m), site_map.sunlit
    tone = site_map.shade / (site_map.shade + max(float(np.median(site_map.shade[known])), 1e-3))
    shown = tone[known & lit]
    low, high = np.percentile(shown, [1, 99]) if len(shown) else (0.0, 1.0)
    grey = 70 + 175 * np.clip((tone - low) / max(high - low, 0.05), 0, 1)
    picture = np.where(lit[..., None], grey[..., None], _SHADOW)
    picture[~known] = _UNKNOWN
    return np.rint(picture).astype(np.uint8)


def _pixels(site_map: SiteMap, places_m: Array) -> Array:
    """Pixels (N, 2) of positions (N, 2) on O_L's plane: x is west (left), y is south (down)."""
    scale = _MAP_PX / (2 * site_map.half_width_m)
    return (np.asarray(places_m) - site_map.centre_m) * [-scale, scale] + _MAP_PX / 2


def _draw_line(
    picture: np.ndarray, site_map: SiteMap, places_m: Array, colour: Colour, *, closed: bool = False
) -> None:
    points = np.clip(_pixels(site_map, places_m), -20_000, 20_000) * 2**_SHIFT
    points = np.rint(points).astype(np.int32)[:, None]
    cv2.polylines(picture, [points], closed, colour, 2, cv2.LINE_AA, _SHIFT)


def _draw_square(picture: np.ndarray, site_map: SiteMap) -> None:
    """Draw the extent of the scene's ground if the map extends beyond it."""
    half = site_map.ground_half_m
    if half < 0.99 * site_map.half_width_m:
        _draw_line(picture, site_map, half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), _GROUND, closed=True)


def _draw_site(picture: np.ndarray, u: float, v: float) -> None:
    at = round(u), round(v)
    for colour, width in (((255, 255, 255), 4), (_SITE, 2)):
        cv2.circle(picture, at, 10, colour, width, cv2.LINE_AA)
        for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            first, last = (at[0] + 10 * du, at[1] + 10 * dv), (at[0] + 18 * du, at[1] + 18 * dv)
            cv2.line(picture, first, last, colour, width, cv2.LINE_AA)


def _draw_scale(picture: np.ndarray, pixel_m: float) -> None:
    """Draw a scale bar of a round length, at most a quarter of the map."""
    most = picture.shape[1] * pixel_m / 4
    digit = 10.0 ** np.floor(np.log10(most))
    length = float(digit * max(k for k in (1, 2, 5) if k * digit <= most))
    text = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    end, base = 20 + round(length / pixel_m), picture.shape[0] - 24
    cv2.rectangle(picture, (10, base - 34), (end + 12, base + 14), _PAPER, -1)
    cv2.rectangle(picture, (20, base), (end, base + 5), _INK, -1)
    _write(picture, text, (20, base - 10))


def _facts(
    site_map: SiteMap, plan: ScenePlan, place_deg: tuple[float, float], horizon: SiteHorizon
) -> list[tuple[str, Colour]]:
    """Lines of the legend about site, Sun and heights, with their colours."""
    height = site_map.height_m[np.isfinite(site_map.height_m)]
    dark = horizon.elevation_deg > plan.sun_elevation_deg
    return [
        (plan.scene_id, _FAINT),
        (f"site: latitude {place_deg[0]:.5f} deg", _INK),
        (f"      longitude {place_deg[1]:.5f} deg", _INK),
        (f"Sun: azimuth {plan.sun_azimuth_deg % 360:.1f} deg", _INK),
        (f"      elevation {plan.sun_elevation_deg:.1f} deg", _INK),
        (f"horizon towards the Sun: {horizon.elevation_deg:.1f} deg", _INK),
        (f"the site lies {'in shadow' if dark else 'in the sun'}", (0, 0, 200) if dark else (0, 130, 0)),
        (f"heights: {height.min():.0f} to {height.max():.0f} m", _INK),
    ]


def _draw_legend(
    picture: np.ndarray,
    name: str,
    facts: list[tuple[str, Colour]],
    site_map: SiteMap,
    azimuth_deg: float,
    n_tracks: int,
) -> None:
    """Write the name and the facts, and draw the compass and the key of the map's colours."""
    left, top = _MAP_PX + 2 * _EDGE_PX, _EDGE_PX + 18
    _write(picture, name[:26], (left, top), 0.6)
    for text, colour in facts:
        top += 26
        _write(picture, text, (left, top), colour=colour)
    _draw_compass(picture, (left + 90, top + 110), azimuth_deg)
    top += 220
    keys: list[tuple[Colour, str]] = [(_TRACK, f"ground tracks ({n_tracks}), from the dot")]
    if site_map.ground_half_m < 0.99 * site_map.half_width_m:
        keys.append((_GROUND, "ground that is rendered"))
    if site_map.outline_m is not None:
        keys.append((_OUTLINE, "edge of the elevation model"))
    for colour, text in keys:
        cv2.line(picture, (left, top - 5), (left + 30, top - 5), colour, 3, cv2.LINE_AA)
        _write(picture, text, (left + 46, top))
        top += 30
    _draw_site(picture, left + 15, top + 2)
    _write(picture, "landing site", (left + 46, top + 7))
    boxes = [(tuple(_SHADOW), "shadow")]
    if not np.isfinite(site_map.height_m).all():
        boxes.append((_UNKNOWN, "no heights"))
    top += 46
    for colour, text in boxes:
        cv2.rectangle(picture, (left, top - 14), (left + 30, top + 4), colour, -1)
        _write(picture, text, (left + 46, top))
        top += 30


def _draw_compass(picture: np.ndarray, at: tuple[int, int], azimuth_deg: float) -> None:
    """Draw an arrow towards north, and an arrow along the direction in which sunlight crosses the map."""
    cv2.circle(picture, at, 50, _FAINT, 1, cv2.LINE_AA)
    cv2.arrowedLine(picture, (at[0], at[1] + 40), (at[0], at[1] - 40), _INK, 2, cv2.LINE_AA, tipLength=0.2)
    _write(picture, "N", (at[0] - 6, at[1] - 58))
    towards = np.array([np.sin(np.radians(azimuth_deg)), -np.cos(np.radians(azimuth_deg))])
    sun, tip = (tuple(np.rint(at + r * towards).astype(int).tolist()) for r in (66, 22))
    cv2.arrowedLine(picture, sun, tip, (0, 150, 230), 2, cv2.LINE_AA, tipLength=0.3)
    cv2.circle(picture, sun, 9, (0, 190, 255), -1, cv2.LINE_AA)
    cv2.circle(picture, sun, 9, (0, 150, 230), 1, cv2.LINE_AA)


def _write(picture: np.ndarray, text: str, at: tuple[int, int], size: float = 0.5, colour: Colour = _INK) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
