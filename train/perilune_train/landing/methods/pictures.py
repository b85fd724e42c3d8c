"""Draw errors by altitude, filter errors with their bands, and craters matched in a frame."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.locate import Located
from perilune_train.landing.craters.projection import projected
from perilune_train.landing.fly.picture import draw_band
from perilune_train.landing.methods.flights import BAND
from perilune_train.landing.methods.seen import SeenDescent
from perilune_train.records.pictures import save_figure

_MAX_DESCENTS = 8
_ALTITUDES_M = np.array([200, 300, 400, 600, 800, 1000, 1300, 1600])
_ENLARGED = 4


def draw_by_altitude(path: Path, tables: dict[str, pd.DataFrame]) -> None:
    """Draw position errors (median, 5 to 95 %) and normalised errors squared by altitude.

    Each table has altitude_m, error_m and squared, one row per frame; frames without an estimate have NaN.
    """
    figure = Figure(figsize=(14, 5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for k, (method, table) in enumerate(tables.items()):
        number = np.digitize(table["altitude_m"], _ALTITUDES_M)
        groups = table[table["error_m"].notna()].groupby(number[table["error_m"].notna()])
        altitude = groups["altitude_m"].mean()
        left.plot(altitude, groups["error_m"].median(), color=f"C{k}", marker="o", label=method)
        left.fill_between(
            altitude, groups["error_m"].quantile(0.05), groups["error_m"].quantile(0.95), color=f"C{k}", alpha=0.15
        )
        right.plot(table["altitude_m"], table["squared"], ".", color=f"C{k}", markersize=3, label=method)
    left.set_yscale("log")
    _label(left, "position error: median and 5 to 95 %", "altitude (m)", "error (m)")
    left.legend()
    right.axhspan(*BAND, color="black", alpha=0.1, label="95 % if the covariance is correct")
    right.set_yscale("log")
    right.legend()
    _label(right, "normalised error squared of position and attitude", "altitude (m)", "")
    for axis in (left, right):
        axis.invert_xaxis()
    save_figure(path, figure)


def draw_flights(path: Path, flown: pd.DataFrame) -> None:
    """Draw the errors of the filter along at most eight descents, with bands of three standard deviations."""
    groups = list(flown.groupby(["scene_id", "trajectory_id"]))[:_MAX_DESCENTS]
    figure = Figure(figsize=(14, 2.2 * len(groups) + 0.6), layout="constrained")
    axes = figure.subplots(len(groups), 3, squeeze=False, sharex=True)
    for row, (ids, flight) in zip(axes, groups, strict=True):
        for axis, panel in zip("xyz", row, strict=True):
            draw_band(panel, flight, axis)
            _label(panel, f"{'/'.join(map(str, ids))}: {axis}", "", "m")
    for panel in axes[-1]:
        panel.set_xlabel("time (s)")
    axes[0, 0].legend()
    save_figure(path, figure)


def draw_matches(
    path: Path, image: NDArray[np.uint8], descent: SeenDescent, frame: int, catalogue: Catalogue, located: Located
) -> None:
    """Draw a frame: matched (cyan) and unmatched (red) detections, and the projected catalogue (yellow)."""
    figure = Figure(figsize=(9, 9.4), layout="constrained")
    axis = figure.subplots()
    enlarged = cv2.resize(image, None, fx=_ENLARGED, fy=_ENLARGED, interpolation=cv2.INTER_CUBIC)
    height, width = image.shape
    axis.imshow(
        enlarged, cmap="gray", extent=(0, width, height, 0), vmin=0, vmax=max(1.0, float(np.percentile(image, 99.5)))
    )
    sightings, angle = descent.sightings[frame], np.linspace(0, 2 * np.pi, 60)
    matched = set(located.fix.sighting.tolist())
    for number, (centre, radius) in enumerate(zip(sightings.centre_px, sightings.radius_px, strict=True)):
        colour = "cyan" if number in matched else "red"
        axis.plot(centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle), color=colour, linewidth=1)
    seen = projected(catalogue, descent.camera, located.fix.pose, least_radius_px=float(sightings.radius_px.min()))
    axis.plot(*seen.centre_px.T, "+", color="yellow", markersize=5)
    axis.set(xlim=(0, width), ylim=(height, 0))
    axis.axis("off")
    n = len(sightings)
    axis.set_title(
        f"{'/'.join(descent.ids)}, {descent.true[frame].position_m[2]:.0f} m: {len(matched)} of {n} detections matched"
    )
    save_figure(path, figure)


def _label(axis: Axes, title: str, x: str, y: str) -> None:
    axis.set(title=title, xlabel=x, ylabel=y)
    axis.grid(alpha=0.3)
