"""Read a crater catalogue, in the site frame or by latitude and longitude; untrusted input."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from perilune_shared.console.progress import say
from perilune_shared.errors import UserError
from perilune_shared.geometry.curvature import drop_m
from perilune_shared.geometry.frames import MOON_RADIUS_M, Array, site_from_selenographic
from perilune_shared.storage.tables.catalogues import duplicates, read_craters
from perilune_shared.storage.tables.columns import Columns, Kind
from perilune_shared.storage.tables.limits import CATALOGUE
from perilune_shared.storage.tables.read import open_table
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.fly.tables import CRATER_COLUMNS, NORMAL_COLUMNS

_SETTING = "prior.catalogue_columns"
_SITE_FRAME: dict[str, Kind] = dict.fromkeys((*CRATER_COLUMNS, *NORMAL_COLUMNS), "number")
_HEIGHT = "height_m"
_REACH_M = 200_000.0
"""Largest distance from the site, metres, at which craters listed by latitude and longitude are used."""


@dataclass(frozen=True, slots=True)
class CatalogueUse:
    """Stated errors of a catalogue, and how its columns are read."""

    position_sigma_m: float
    """Standard deviation of a crater's position, per axis, metres."""
    diameter_sigma_share: float
    """Standard deviation of a crater's diameter, as a share of the diameter."""
    site_deg: tuple[float, float] | None = None
    """Latitude and longitude of the site, degrees; needed for a catalogue by latitude and longitude."""
    columns: Mapping[str, str] = field(default_factory=dict)
    """Column names of a catalogue by latitude and longitude; if empty, they are recognised."""


def read_catalogue(path: Path, use: CatalogueUse) -> Catalogue:
    """Read a crater catalogue, Parquet or CSV.

    A catalogue in the site frame has the columns x_m, y_m, z_m, diameter_m and optionally normal_x, normal_y, normal_z;
    without normals the rims are level. A catalogue by latitude and longitude has the columns that `read_craters` reads
    and optionally height_m, the height above the sphere through the site. Raises UserError on a missing column or an
    invalid value.
    """
    with open_table(path, CATALOGUE) as table:
        if not table.names or set(CRATER_COLUMNS[:3]) & set(table.names):
            return _in_site_frame(
                table.read({name: "number" for name in (*CRATER_COLUMNS, *NORMAL_COLUMNS)}, CRATER_COLUMNS), use
            )
    return _by_latitude(path, use)


def _in_site_frame(columns: Columns, use: CatalogueUse) -> Catalogue:
    centre = np.column_stack([columns.finite(name) for name in CRATER_COLUMNS[:3]])
    diameter = columns.finite("diameter_m")
    if not len(diameter):
        raise UserError(columns.path, "rows", 0, "at least one crater")
    columns.check("diameter_m", diameter > 0, "above 0")
    normal = np.tile([0.0, 0.0, 1.0], (len(diameter), 1))
    if all(name in columns for name in NORMAL_COLUMNS):
        normal = np.column_stack([columns.finite(name) for name in NORMAL_COLUMNS])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        columns.check("normal_x", length[:, 0] > 0, "a normal that is not zero")
        normal = normal / length
    return _catalogue(centre, normal, diameter, use)


def _by_latitude(path: Path, use: CatalogueUse) -> Catalogue:
    """Read a catalogue by latitude and longitude, and print how many of its craters are used."""
    listed = read_craters(path, _SETTING, use.columns, [_HEIGHT])
    if use.site_deg is None:
        expected = "site_latitude_deg and site_longitude_deg in prior.yaml, since the catalogue has no x_m, y_m, z_m"
        raise UserError(path, "site", "none", expected)
    x, y = site_from_selenographic(listed.latitude_deg, listed.longitude_deg, *use.site_deg)
    near = np.flatnonzero(np.hypot(x, y) <= _REACH_M)
    used = near[~duplicates(x[near], y[near], listed.diameter_m[near])]
    far, twice = len(x) - len(near), len(near) - len(used)
    found = f"{len(used)} used, {far} farther than {_REACH_M / 1000:g} km from the site, {twice} listed twice"
    if not len(used):
        raise UserError(path, "craters", found, "at least one crater near the site")
    say(f"{path.name}: {found}")
    x, y = x[used], y[used]
    drop = drop_m(x, y)
    height = listed.columns.finite(_HEIGHT)[used] if _HEIGHT in listed.columns else np.zeros(len(used))
    up = np.column_stack([x, y, MOON_RADIUS_M - drop])
    normal = up / np.linalg.norm(up, axis=1, keepdims=True)
    return _catalogue(np.column_stack([x, y, height - drop]), normal, listed.diameter_m[used], use)


def _catalogue(centre_m: Array, normal: Array, diameter_m: Array, use: CatalogueUse) -> Catalogue:
    """Make the catalogue, largest craters first."""
    order = np.argsort(-diameter_m, kind="stable")
    radius = diameter_m[order] / 2
    return Catalogue(centre_m[order], normal[order], radius, use.position_sigma_m, use.diameter_sigma_share)
