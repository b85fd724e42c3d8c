"""Draw a flight: path, position errors with three-sigma bands, and number of matched craters."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from perilune_train.records.pictures import save_figure

_STATUS = {"tracking": ("tab:blue", "o"), "coasting": ("tab:orange", "s"), "lost": ("tab:red", "x")}

_START = 3
"""Number of frames at the start that do not affect the scale of the axes."""


def draw_flight(path: Path, estimates: pd.DataFrame) -> None:
    """Draw the estimates of a flight, one row per frame; if true poses are known, also the errors."""
    figure = Figure(figsize=(14, 8), layout="constrained")
    axes = figure.subplots(2, 3)
    for status, (colour, marker) in _STATUS.items():
        own = estimates[estimates["status"] == status]
        if own.empty:
            continue
        style = {"color": colour, "marker": marker, "linestyle": "none", "markersize": 4, "label": status}
        axes[0, 0].plot(own["time_s"], own["z_m"], **style)
        axes[0, 1].plot(own["x_m"], own["y_m"], **style)
        axes[0, 2].plot(own["time_s"], own["n_matched"], **style)
    _label(axes[0, 0], "height", "time (s)", "z (m)")
    axes[0, 0].legend()
    _label(axes[0, 1], "path from above", "x (m)", "y (m)")
    axes[0, 1].axis("equal")
    _label(axes[0, 2], "craters matched", "time (s)", "number")
    known = "error_x_m" in estimates
    for axis, place in zip("xyz", (axes[1, 0], axes[1, 1], axes[1, 2]), strict=True):
        draw_band(place, estimates, axis)
        _label(place, f"{axis}: {'error' if known else 'deviation'}", "time (s)", "m")
    axes[1, 0].legend()
    save_figure(path, figure)


def draw_band(place: Axes, estimates: pd.DataFrame, axis: str) -> None:
    """Draw three standard deviations of the position on one axis (x, y or z) and, if known, the error."""
    time_s, band = estimates["time_s"], 3 * estimates[f"sigma_{axis}_m"].to_numpy()
    place.fill_between(time_s, -band, band, color="tab:blue", alpha=0.2, linewidth=0, label="3 sigma")
    error = estimates.get(f"error_{axis}_m", pd.Series(0.0, estimates.index)).to_numpy()
    if f"error_{axis}_m" in estimates:
        place.plot(time_s, error, color="black", linewidth=1.5, label="error")
    # The uncertainty at the start is far larger than in the rest of the flight.
    late = slice(min(_START, len(band) - 1), None)
    height = 1.2 * max(float(band[late].max()), float(np.abs(error[late]).max()))
    place.set_ylim(-height, height)


def _label(axis: Axes, title: str, x: str, y: str) -> None:
    axis.set(title=title, xlabel=x, ylabel=y)
    axis.grid(alpha=0.3)
