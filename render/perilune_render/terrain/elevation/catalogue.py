"""Craters of a real elevation model, read from a CSV catalogue; they become labels like generated craters."""

import csv
from pathlib import Path

import numpy as np

from perilune_render.config_terrain import CratersConfig
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.elevation.model import ElevationModel, raster_places
from perilune_render.terrain.grid import Grid
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, site_from_selenographic

_LARGEST_BYTES = 500_000_000
_COLUMNS = {"longitude_deg": (-180.0, 360.0), "latitude_deg": (-90.0, 90.0), "diameter_m": (0.0, 1e7)}


def read_catalogue(path: Path, model: ElevationModel, grid: Grid, config: CratersConfig, smallest_m: float) -> Craters:
    """The catalogue's craters that the model shows, largest first, with origin 'elevation model'.

    These are the craters larger than `smallest_m` with centre and rim on the grid and on measured pixels of the model;
    smaller craters are generated.

    The file needs a header with longitude_deg (east), latitude_deg (north) and diameter_m; other columns are ignored.
    Age and fresh depth are unknown (NaN), wear is 0. Raises UserError with the line of an error.
    """
    if not path.is_file():
        raise UserError(path, "catalogue", "no such file", "a CSV file of craters")
    if path.stat().st_size > _LARGEST_BYTES:
        raise UserError(path, "catalogue", f"{path.stat().st_size} bytes", f"at most {_LARGEST_BYTES}")
    rows = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as text:
            reader = csv.DictReader(text, skipinitialspace=True)
            names = reader.fieldnames or []
            for name in _COLUMNS:
                if name not in names:
                    raise UserError(path, name, f"columns {', '.join(names) or 'none'}", "a column of this name")
            for row in reader:
                rows.append([_number(path, reader.line_num, name, row[name]) for name in _COLUMNS])
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(path, "catalogue", error, "a CSV file in UTF-8") from None
    longitude, latitude, diameter = np.array(rows, np.float64).reshape(-1, 3).T
    x, y = site_from_selenographic(latitude, longitude, model.latitude_deg, model.longitude_deg)
    shown = (np.maximum(np.abs(x), np.abs(y)) + diameter / 2 < grid.extent_m / 2) & (diameter > smallest_m)
    shown[shown] = _measured(model, x[shown], y[shown], diameter[shown])
    chosen = np.flatnonzero(shown)[np.argsort(-diameter[shown], kind="stable")]
    unknown = np.full(len(chosen), np.nan)
    return Craters.round(
        x[chosen],
        y[chosen],
        diameter[chosen],
        unknown,
        unknown,
        np.zeros(len(chosen)),
        config.profile,
        "elevation model",
    )


def _measured(model: ElevationModel, x_m: Array, y_m: Array, diameter_m: Array) -> np.ndarray:
    """Whether the centre and 16 rim points of each crater (N,) are on pixels with a measured height."""
    angle = np.append(2 * np.pi * np.arange(16) / 16, 0)
    reach = np.append(np.ones(16), 0) * diameter_m[:, None] / 2
    column, row = raster_places(model, x_m[:, None] + reach * np.cos(angle), y_m[:, None] + reach * np.sin(angle))
    n_rows, n_columns = model.known.shape
    inside = (column >= 0) & (column < n_columns) & (row >= 0) & (row < n_rows)
    known = model.known[np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)]
    return (inside & known).all(axis=1)


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    low, high = _COLUMNS[name]
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not low <= value <= high or (name == "diameter_m" and value == 0):
        raise UserError(f"{path}:{line}", name, text or "nothing", f"a number from {low:g} to {high:g}")
    return value
