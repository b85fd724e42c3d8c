"""Craters that a real elevation model itself shows, from a catalogue in CSV: they become labels like all others."""

import csv
from pathlib import Path

import numpy as np

from perilune_render.config import CratersConfig
from perilune_render.terrain.craters import Craters
from perilune_render.terrain.elevation import ElevationModel
from perilune_render.terrain.grid import Grid
from perilune_shared.errors import UserError
from perilune_shared.frames import site_from_selenographic

_LARGEST_BYTES = 500_000_000
_COLUMNS = {"longitude_deg": (-180.0, 360.0), "latitude_deg": (-90.0, 90.0), "diameter_m": (0.0, 1e7)}


def read_catalogue(path: Path, model: ElevationModel, grid: Grid, config: CratersConfig) -> Craters:
    """The catalogue's craters whose centre lies on the grid, largest first, with origin 'elevation model'.

    The file needs a header with longitude_deg (east), latitude_deg (north) and diameter_m; other columns are ignored.
    Age and fresh depth are not known (NaN), wear is 0. Raises UserError with the line of a fault.
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
    on_grid = (np.maximum(np.abs(x), np.abs(y)) < grid.extent_m / 2) & (diameter < grid.extent_m)
    chosen = np.flatnonzero(on_grid)[np.argsort(-diameter[on_grid], kind="stable")]
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


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    low, high = _COLUMNS[name]
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not low <= value <= high or (name == "diameter_m" and value == 0):
        raise UserError(f"{path}:{line}", name, text or "nothing", f"a number from {low:g} to {high:g}")
    return value
