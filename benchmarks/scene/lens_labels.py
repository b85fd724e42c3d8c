"""How far the ellipse of a label is from the projected rim under a fisheye and a unified camera of 180 degrees.

For rims on level ground, 500 m below the camera, the figure is the largest distance of a rim point from its label's
ellipse, to first order, pixels. The table has the median and the worst rim by label radius and angle from the axis.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import Ellipses, project_circles, rim_points
from perilune_shared.geometry.frames import Array

_SIDE_PX, _N_RIMS, _N_POINTS, _HEIGHT_M = 256, 40_000, 90, 500.0
_MIN_RADIUS_M, _MAX_RADIUS_M, _MAX_ANGLE_DEG = 5.0, 400.0, 85.0
_RADII_PX = (2, 5), (5, 10), (10, 20), (20, 50)
_ANGLES_DEG = (0, 30), (30, 50), (50, 70), (70, 85)
_SHAPE = "cx_px", "cy_px", "a_px", "b_px", "theta_rad"
_MIDDLE_PX, _EQUIDISTANT_PX = _SIDE_PX / 2, _SIDE_PX / np.pi
CAMERAS = {
    "equidistant": Camera(
        _SIDE_PX, _SIDE_PX, _EQUIDISTANT_PX, _EQUIDISTANT_PX, _MIDDLE_PX, _MIDDLE_PX, model="equidistant"
    ),
    "unified": Camera(
        _SIDE_PX, _SIDE_PX, _MIDDLE_PX, _MIDDLE_PX, _MIDDLE_PX, _MIDDLE_PX, model="unified", parameters=(1.0,)
    ),
}


def distances_px(ellipses: Ellipses, points: Array) -> Array:
    """Distances (N, M), to first order, of points (N, M, 2) from their ellipses."""
    cx, cy, a, b, theta = (getattr(ellipses, name)[:, None] for name in _SHAPE)
    dx, dy = points[..., 0] - cx, points[..., 1] - cy
    u, v = dx * np.cos(theta) + dy * np.sin(theta), dy * np.cos(theta) - dx * np.sin(theta)
    return np.abs((u / a) ** 2 + (v / b) ** 2 - 1) / (2 * np.hypot(u / a**2, v / b**2))


def deviations(camera: Camera) -> dict[str, dict[str, float]]:
    """Median and worst deviation by radius and angle."""
    rng = np.random.default_rng(0)
    angle, azimuth = np.radians(rng.uniform(0, _MAX_ANGLE_DEG, _N_RIMS)), rng.uniform(0, 2 * np.pi, _N_RIMS)
    across_m = _HEIGHT_M * np.tan(angle)
    centre_m = np.stack([across_m * np.cos(azimuth), across_m * np.sin(azimuth), np.full(_N_RIMS, _HEIGHT_M)], 1)
    normal = np.tile([0.0, 0.0, -1.0], (_N_RIMS, 1))
    radius_m = np.exp(rng.uniform(np.log(_MIN_RADIUS_M), np.log(_MAX_RADIUS_M), _N_RIMS))
    ellipses = project_circles(camera, centre_m, normal, radius_m)
    radius_px = ellipses.radius_px()
    labelled = np.isfinite(radius_px) & (radius_px >= _RADII_PX[0][0]) & (radius_px <= _RADII_PX[-1][1])
    kept = Ellipses(*(getattr(ellipses, name)[labelled] for name in _SHAPE))
    points = camera.project(rim_points(centre_m[labelled], normal[labelled], radius_m[labelled], _N_POINTS))
    worst_px, radius_px, angle_deg = distances_px(kept, points).max(1), radius_px[labelled], np.degrees(angle[labelled])
    table = {}
    for low_px, high_px in _RADII_PX:
        for low_deg, high_deg in _ANGLES_DEG:
            of_size = (radius_px >= low_px) & (radius_px < high_px)
            some = worst_px[of_size & (angle_deg >= low_deg) & (angle_deg < high_deg)]
            if len(some):
                name = f"{low_px}-{high_px} px, {low_deg}-{high_deg} degrees"
                table[name] = {"median_px": float(np.median(some)), "max_px": float(some.max()), "rims": len(some)}
    return table


def main(
    out: Annotated[Path, typer.Option(help="File of figures to write.")] = Path("runs/bench/lens_labels.json"),
) -> None:
    """Write the deviations of label ellipses from projected rims."""
    write_figures(out, {name: deviations(camera) for name, camera in CAMERAS.items()})


if __name__ == "__main__":
    run_command_line(one_command(main))
