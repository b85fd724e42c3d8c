"""Craters of a real elevation model, read from a catalogue.

They get labels, like generated craters.
"""

import functools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from perilune_render.config.terrain import CatalogueColumnsConfig, TerrainConfig
from perilune_render.terrain.craters.population import ORIGINS, Craters
from perilune_render.terrain.craters.profile import fresh_rim_height_m
from perilune_render.terrain.elevation.crests import measure_crests
from perilune_render.terrain.elevation.model import ElevationModel, raster_places, resolved_m
from perilune_render.terrain.grid import Grid
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, site_from_selenographic
from perilune_shared.storage.tables.catalogues import SurfaceCraters, duplicates, read_craters

_SETTING = "dataset.terrain.elevation.catalogue_columns"
_LIKELY_KM = 10.0
"""If all diameters of a catalogue are below this value in metres, they are probably in kilometres."""


@dataclass(frozen=True, slots=True)
class Counts:
    """How many craters of a catalogue are used, and why the other craters are not used."""

    used: int
    """Number of craters that become labels."""
    measured: int
    """Number of used craters whose rims are measured in the model; the other used craters keep the catalogue's rims."""
    outside: int
    """Number of craters whose centre or rim is outside the ground."""
    unmeasured: int
    """Number of craters whose centre or rim is outside the model or in one of its holes."""
    too_small: int
    """Number of craters inside the model that are too small for it to show."""
    duplicate: int
    """Number of craters that repeat another crater."""

    def __str__(self) -> str:
        """Return the counts as text; counts of unused craters are omitted if they are 0."""
        others = {
            "outside the ground": self.outside,
            "outside the model or in its holes": self.unmeasured,
            "too small for the model": self.too_small,
            "listed twice": self.duplicate,
        }
        used = f"{self.used} used"
        if self.used:
            used += f" ({self.measured} rims measured in the model, {self.used - self.measured} as listed)"
        return ", ".join([used, *(f"{count} {name}" for name, count in others.items() if count)])


@dataclass(frozen=True, slots=True)
class RealCraters:
    """The craters of a catalogue that the model shows."""

    craters: Craters
    """The craters, largest first, with origin 'elevation model'."""
    counts: Counts
    """Numbers of used and unused craters."""


def read_catalogue(path: Path, model: ElevationModel, grid: Grid, config: TerrainConfig) -> RealCraters:
    """Read the craters of a catalogue that the model shows.

    These are the craters larger than `resolved_m` whose centre and rim are on the grid and on measured pixels of the
    model; smaller craters are generated. Position and diameter are measured on the crest in the model. They are taken
    from the catalogue if no crest is found, or if the configuration prefers the catalogue. Age and fresh depth are
    unknown (NaN); wear is 0.

    The columns are recognised (`perilune_shared.storage.tables.catalogues`) or stated in the configuration. Raises
    UserError for a faulty row, with the line number, or if no crater can be used.
    """
    listed = _listed(path, config.elevation.catalogue_columns)
    smallest_m = resolved_m(model)
    x, y = site_from_selenographic(listed.latitude_deg, listed.longitude_deg, model.latitude_deg, model.longitude_deg)
    near = _inside(grid, x, y, listed.diameter_m)
    n_outside = int((~near).sum())
    x, y, listed_m = x[near], y[near], listed.diameter_m[near]
    large = listed_m > smallest_m
    covered = large.copy()
    covered[large] = _measured(model, x[large], y[large], listed_m[large])
    chosen = np.flatnonzero(covered)
    n_twice = int(duplicates(x[chosen], y[chosen], listed_m[chosen]).sum())
    chosen = chosen[~duplicates(x[chosen], y[chosen], listed_m[chosen])]
    n_unmeasured, n_small = int((large & ~covered).sum()), int((~large).sum())
    x, y, listed_m = x[chosen], y[chosen], listed_m[chosen]
    diameter, rms, ratio = listed_m, np.full(len(x), np.nan), np.full(len(x), np.nan)
    if config.elevation.rims == "measured":
        crests = measure_crests(model, x, y, listed_m)
        x, y, diameter = (
            np.where(crests.found, measured, listed_value)
            for measured, listed_value in ((crests.x_m, x), (crests.y_m, y), (crests.diameter_m, listed_m))
        )
        rms, ratio = crests.rms_share, crests.axis_ratio
    # A measured rim larger than the catalogued one may extend beyond the ground or the model.
    on_grid = _inside(grid, x, y, diameter)
    usable = on_grid.copy()
    usable[on_grid] = _measured(model, x[on_grid], y[on_grid], diameter[on_grid])
    counts = Counts(
        used=int(usable.sum()),
        measured=int(np.isfinite(rms[usable]).sum()),
        outside=n_outside + int((~on_grid).sum()),
        unmeasured=n_unmeasured + int((on_grid & ~usable).sum()),
        too_small=n_small,
        duplicate=n_twice,
    )
    if not counts.used:
        raise _nothing_used(path, listed, counts, smallest_m)
    order = np.flatnonzero(usable)[np.argsort(-diameter[usable], kind="stable")]
    unknown = np.full(len(order), np.nan)
    craters = replace(
        Craters.round(x[order], y[order], diameter[order], unknown, unknown, np.zeros(len(order))),
        rim_height_m=fresh_rim_height_m(diameter[order], unknown, config.craters.profile),
        origin=np.full(len(order), ORIGINS.index("elevation model")),
    )
    if config.elevation.rims == "measured":
        craters = replace(
            craters, listed_diameter_m=listed_m[order], rim_rms_share=rms[order], rim_axis_ratio=ratio[order]
        )
    return RealCraters(craters, counts)


def remark(path: Path, real: RealCraters) -> str:
    """A message for the user about a catalogue, shown before the ground is generated."""
    return f"{path.name}: {real.counts}"


def _listed(path: Path, columns: CatalogueColumnsConfig) -> SurfaceCraters:
    """Read a catalogue once for all scenes, since a global catalogue takes seconds to read."""
    try:
        state = path.stat()
    except (OSError, ValueError):
        raise UserError(path, "catalogue", "no such file", "a CSV or Parquet file of craters") from None
    return _read(path, state.st_mtime_ns, state.st_size, tuple(columns.stated.items()))


@functools.lru_cache(maxsize=1)
def _read(path: Path, time_ns: int, n_bytes: int, stated: tuple[tuple[str, str], ...]) -> SurfaceCraters:
    return read_craters(path, _SETTING, dict(stated))


def _nothing_used(path: Path, listed: SurfaceCraters, counts: Counts, smallest_m: float) -> UserError:
    expected = f"at least one crater of more than {smallest_m:.3g} m with its rim on the ground"
    if len(listed.diameter_m) and listed.size.endswith("_m") and listed.diameter_m.max() < _LIKELY_KM:
        largest, column = listed.diameter_m.max(), listed.names[listed.size]
        expected += f"; the largest of {column} is {largest:.3g} m: state kilometres with {_SETTING}"
    return UserError(path, "craters", counts if len(listed.diameter_m) else "no row", expected)


def _inside(grid: Grid, x_m: Array, y_m: Array, diameter_m: Array) -> np.ndarray:
    """Whether the whole rim of each crater (N,) is on the grid."""
    return np.maximum(np.abs(x_m), np.abs(y_m)) + diameter_m / 2 < grid.extent_m / 2


def _measured(model: ElevationModel, x_m: Array, y_m: Array, diameter_m: Array) -> np.ndarray:
    """Whether the centre and 16 rim points of each crater (N,) are on pixels with a measured height."""
    angle = np.append(2 * np.pi * np.arange(16) / 16, 0)
    reach = np.append(np.ones(16), 0) * diameter_m[:, None] / 2
    column, row = raster_places(model, x_m[:, None] + reach * np.cos(angle), y_m[:, None] + reach * np.sin(angle))
    n_rows, n_columns = model.known.shape
    inside = (column >= 0) & (column < n_columns) & (row >= 0) & (row < n_rows)
    known = model.known[np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)]
    return (inside & known).all(axis=1)
