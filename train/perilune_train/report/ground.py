"""Draw a shaded map of a scene from its crater table, with the ground tracks of its trajectories."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_train.report.content import Figure
from perilune_train.report.pictures import COLOURS, DASHES, drawing, label_axes, plain, svg_of
from perilune_train.report.sources import provenance_of_dataset

Array = NDArray[np.float64]
_SIDE_PX = 480
_MIN_DIAMETER_PX = 2.5
_REACH_RADII = 2.5
_RIM_SHARE = 0.18
"""Height of the rim above the plain, divided by the depth: 0.036 D / 0.2 D in fresh craters (Pike 1977)."""
_MARGIN_M = 250.0
_MAX_TRACKS = 6


def shaded_ground(craters: pd.DataFrame, sun: Array, half_m: float, side_px: int = _SIDE_PX) -> NDArray[np.uint8]:
    """Shaded grey map (side_px, side_px) of a square of ground with sides of 2 half_m, centred on the site.

    Row 0 has the lowest y, column 0 the lowest x. `craters` has the columns x_m, y_m, diameter_m and depth_m. `sun` is
    a unit vector (3,) towards the Sun, O_L. Each crater is a parabolic bowl with a rim. The height of the rim falls
    with the cube of the distance and is 0 beyond 2.5 radii. The brightness follows Lambert's law, without cast shadows.
    Relief and boulders are not in the crater table, so they are not drawn.
    """
    pixel_m = 2 * half_m / side_px
    axis = (np.arange(side_px) + 0.5) * pixel_m - half_m
    height = np.zeros((side_px, side_px))
    columns = ("x_m", "y_m", "diameter_m", "depth_m")
    for x, y, diameter, depth in zip(*(craters[name].to_numpy() for name in columns), strict=True):
        reach = _REACH_RADII * diameter / 2
        across, along = np.flatnonzero(np.abs(axis - x) < reach), np.flatnonzero(np.abs(axis - y) < reach)
        if not len(across) or not len(along):
            continue
        r = np.hypot(axis[across][None] - x, axis[along][:, None] - y) / (diameter / 2)
        bowl = depth * (np.minimum(r, 1) ** 2 - 1) + _RIM_SHARE * depth * (np.maximum(r, 1) ** -3 - _REACH_RADII**-3)
        height[np.ix_(along, across)] += np.where(r < _REACH_RADII, bowl, 0)
    slope_y, slope_x = np.gradient(height, pixel_m)
    light = (sun[2] - slope_x * sun[0] - slope_y * sun[1]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    return np.clip(255 * 0.6 * light / max(sun[2], 0.05), 0, 255).astype(np.uint8)


def scene_map(dataset: Dataset, scene_id: str) -> Figure:
    """Draw the map of a scene under its Sun, north up, with the ground tracks of at most six of its trajectories."""
    columns = ["trajectory_id", "frame_index", "position_m", "sun_direction"]
    frames = dataset.table("frames", columns, scene_id=scene_id).to_pandas()
    frames = frames.sort_values(["trajectory_id", "frame_index"])
    sun = np.asarray(frames["sun_direction"].iloc[0], np.float64)
    position = np.stack([np.asarray(position_m, np.float64) for position_m in frames["position_m"]])
    half_m = float(np.abs(position[:, :2]).max() + _MARGIN_M)
    craters = dataset.table("craters", ["x_m", "y_m", "diameter_m", "depth_m"], scene_id=scene_id).to_pandas()
    min_m = _MIN_DIAMETER_PX * 2 * half_m / _SIDE_PX
    drawn = craters[craters["diameter_m"] >= min_m]
    tracks = list(frames.groupby("trajectory_id").indices.items())[:_MAX_TRACKS]
    with drawing(height_in=5.0) as figure:
        axes = figure.subplots()
        # x points west and y south, so reverse columns and rows to have north up and east to the right.
        image = shaded_ground(drawn, sun / np.linalg.norm(sun), half_m)[::-1, ::-1]
        axes.imshow(image, cmap="gray", vmin=0, vmax=255, origin="lower", extent=(-half_m, half_m, -half_m, half_m))
        for number, (trajectory, rows) in enumerate(tracks):
            path = position[rows]
            colour, dash = COLOURS[(number + 4) % len(COLOURS)], DASHES[number]
            east, north = -path[:, 0], -path[:, 1]
            axes.plot(east, north, color=colour, linestyle=dash, linewidth=2.4, label=plain(trajectory))
            axes.plot(east[0], north[0], "o", color="white", markeredgecolor="black", markersize=6)
        axes.grid(False)
        label_axes(axes, f"{plain(scene_id)} from above", "east (m)", "north (m)")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
        description = f"Shaded map of {scene_id} with the ground tracks of {len(tracks)} trajectories"
        html = svg_of(figure, description)
    caption = (
        f"Scene {scene_id}, shaded from its table of craters ({len(drawn)} above {min_m:.0f} m) under its Sun, with "
        "the ground tracks of its trajectories; a dot marks the first frame. Relief, boulders and cast shadows are not "
        "in the table and are not drawn."
    )
    return Figure(html, caption, (provenance_of_dataset(dataset),))
