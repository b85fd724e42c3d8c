"""Read longitude, latitude and diameter from crater catalogues with known or stated columns.

These catalogues are recognised by their columns: Robbins 2018 (doi 10.1029/2018JE005592), Head et al. 2010, Povilaitis
et al. 2018 (also as LROCCraters.csv of DeepMoon), and the gazetteer of the IAU. A table with latitude, longitude and a
diameter or radius is recognised too if the column name of the size contains the unit, as in craterpy's tables.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.storage.tables.columns import Columns
from perilune_shared.storage.tables.limits import CATALOGUE
from perilune_shared.storage.tables.read import open_table

Array = NDArray[np.float64]
PLACES = ("longitude_deg", "latitude_deg")
"""Keys of the coordinates when a user states columns; east and north are positive."""
METRES = {"diameter_m": 1.0, "diameter_km": 1000.0, "radius_m": 2.0, "radius_km": 2000.0}
"""Keys of the size when a user states columns, with the factor that converts the size to a diameter in metres."""
_KNOWN: dict[str, Mapping[str, str]] = {
    "Robbins 2018": {
        "longitude_deg": "LON_CIRC_IMG",
        "latitude_deg": "LAT_CIRC_IMG",
        "diameter_km": "DIAM_CIRC_IMG",
    },
    "Head et al. 2010 or Povilaitis et al. 2018": {
        "longitude_deg": "x_coord",
        "latitude_deg": "y_coord",
        "diameter_km": "Diam_km",
    },
    "gazetteer of the IAU": {
        "longitude_deg": "Center_Longitude",
        "latitude_deg": "Center_Latitude",
        "diameter_km": "Diameter",
    },
}
"""Columns of catalogues that the patterns do not recognise."""
_UNIT = r"[ _]?[(\[]?{}[)\]]?"
_DEGREES = r"[ _]?[(\[]?(?:deg(?:rees)?)?[ _]?{}[)\]]?"
_PATTERNS = {
    "longitude_deg": re.compile(r"(?:lon|long|longitude)" + _DEGREES.format("(?:e|east)?"), re.IGNORECASE),
    "latitude_deg": re.compile(r"(?:lat|latitude)" + _DEGREES.format("(?:n|north)?"), re.IGNORECASE),
    "diameter_m": re.compile(r"(?:d|diam|diameter)" + _UNIT.format("(?:m|meters|metres)"), re.IGNORECASE),
    "diameter_km": re.compile(r"(?:d|diam|diameter)" + _UNIT.format("(?:km|kilometers|kilometres)"), re.IGNORECASE),
    "radius_m": re.compile(r"(?:r|rad|radius)" + _UNIT.format("(?:m|meters|metres)"), re.IGNORECASE),
    "radius_km": re.compile(r"(?:r|rad|radius)" + _UNIT.format("(?:km|kilometers|kilometres)"), re.IGNORECASE),
}
_MAX_NEIGHBOURS = 100
"""Number of following craters, in the order of x, with which each crater is compared; limits the time for hostile
catalogues."""


@dataclass(frozen=True, slots=True)
class SurfaceCraters:
    """N craters of a catalogue, in the order of the file."""

    longitude_deg: Array
    """Longitudes of the centres, east positive, -180 to 360 degrees (N,)."""
    latitude_deg: Array
    """Latitudes of the centres, north positive, degrees (N,)."""
    diameter_m: Array
    """Diameters, metres (N,)."""
    names: Mapping[str, str]
    """Names of the file's columns, by key: PLACES and one of METRES."""
    columns: Columns
    """All columns that were read, including the additional ones."""

    @property
    def size(self) -> str:
        """Key of the size column: one of METRES."""
        return next(name for name in self.names if name in METRES)


def read_craters(
    path: Path, setting: str, names: Mapping[str, str] | None = None, others: Sequence[str] = ()
) -> SurfaceCraters:
    """Read a catalogue, CSV or Parquet.

    `names` states the columns by key; if it is empty, the columns are recognised. `setting` is the setting in which
    users state columns, for messages. `others` are additional optional columns of numbers. Raises UserError if a column
    is missing or cannot be recognised, and about the first value that is not a valid coordinate or size.
    """
    with open_table(path, CATALOGUE) as table:
        chosen = _stated(path, setting, table.names, names) if names else recognised(path, setting, table.names)
        wanted = {name: "number" for name in (*chosen.values(), *others)}
        columns = table.read(wanted, list(chosen.values()))  # type: ignore[arg-type]
    longitude = columns.finite(chosen["longitude_deg"], -180, 360)
    latitude = columns.finite(chosen["latitude_deg"], -90, 90)
    size = next(name for name in chosen if name in METRES)
    largest = 1e7 / METRES[size]
    values = columns.finite(chosen[size], 0, largest)
    columns.check(chosen[size], values > 0, f"a number above 0, at most {largest:g}")
    return SurfaceCraters(longitude, latitude, values * METRES[size], chosen, columns)


def recognised(path: Path, setting: str, names: Sequence[str]) -> dict[str, str]:
    """Return the names of a catalogue's columns by key. Raises UserError if they cannot be recognised."""
    for known in _KNOWN.values():
        if set(known.values()) <= set(names):
            return dict(known)
    matching = {key: [name for name in names if pattern.fullmatch(name)] for key, pattern in _PATTERNS.items()}
    exact = {key: [key] if key in names else matches for key, matches in matching.items()}
    sizes = [(key, name) for key in METRES for name in exact[key]]
    diameters = [size for size in sizes if size[0].startswith("diameter")]
    sizes = [("diameter_m", "diameter_m")] if "diameter_m" in names else diameters or sizes
    coordinates = [exact[key] for key in PLACES]
    if all(len(matches) == 1 for matches in coordinates) and len(sizes) == 1:
        return {"longitude_deg": coordinates[0][0], "latitude_deg": coordinates[1][0], sizes[0][0]: sizes[0][1]}
    several = [name for matches in (*coordinates, [name for _, name in sizes]) if len(matches) > 1 for name in matches]
    got = (
        f"columns {', '.join(several)}" if several else f"columns {', '.join(name for name in names if name) or 'none'}"
    )
    expected = "longitude_deg, latitude_deg and diameter_m or diameter_km"
    if not several and all(coordinates) and not sizes:
        expected = "a diameter or radius with its unit, as diameter_m or Diameter (km)"
    raise UserError(path, "columns", got, f"{expected}; {setting} can state which columns these are")


def duplicates(x_m: Array, y_m: Array, diameter_m: Array) -> NDArray[np.bool_]:
    """Return whether each of N craters repeats an earlier crater of the catalogue, bool (N,).

    Catalogues joined from several sources contain some craters twice, with slightly different values. Two craters count
    as one if their centres differ by at most a tenth of the larger radius, and their diameters by at most a tenth of
    the larger diameter.
    """
    repeats = np.zeros(len(x_m), bool)
    by_size = np.argsort(diameter_m, kind="stable")
    sizes = diameter_m[by_size]
    for low in np.unique(np.floor(np.log2(sizes))):
        # Compare the craters of one octave of diameters, and slightly larger ones, since two observations of a crater
        # may lie on both sides of the upper limit.
        high = 1.1 * 2 ** (low + 1)
        similar = by_size[slice(*np.searchsorted(sizes, [2**low, high]))]
        order = similar[np.argsort(x_m[similar], kind="stable")]
        for step in range(1, min(len(order), _MAX_NEIGHBOURS)):
            first, second = np.sort([order[:-step], order[step:]], axis=0)
            apart = np.abs(x_m[second] - x_m[first])
            if apart.min() > 0.05 * high:
                break
            larger = np.maximum(diameter_m[first], diameter_m[second])
            near = np.hypot(apart, y_m[second] - y_m[first]) <= 0.05 * larger
            alike = np.abs(diameter_m[second] - diameter_m[first]) <= 0.1 * larger
            repeats[second[near & alike]] = True
    return repeats


def _stated(path: Path, setting: str, names: Sequence[str], stated: Mapping[str, str]) -> dict[str, str]:
    """Return the columns that the user stated. Raises UserError if the file lacks one."""
    missing = [name for name in stated.values() if name not in names]
    if missing:
        raise UserError(
            path, setting, f"no column {', '.join(missing)}", f"columns of {', '.join(names[:20]) or 'none'}"
        )
    return dict(stated)
