"""The recipe that a dataset records, and the conversion from a recipe to a configuration."""

import json
from pathlib import Path
from typing import Any

from perilune_render.config.dataset import DatasetConfig, SensorConfig
from perilune_render.config.terrain import FILE_FIELDS, SITE_FIELDS, ElevationConfig
from perilune_render.provenance.versions import all_versions, device_of, ground_versions
from perilune_shared.config.resolve import resolve_over
from perilune_shared.dataset.metadata import Recipe
from perilune_shared.dataset.names import Kind
from perilune_shared.errors import UserError

_FILES = ("dem", "catalogue")
_SPEED = ("threads", "cache_gib")
DEFAULT_ENGINE = "cycles"
"""Engine that recipes do not record, so that recipes of older versions stay equal."""
_SINCE = ("blur_poses", "row_time_s")
"""Sensor settings that are recorded only if they differ from the defaults, so that older recipes stay equal."""
_TILT = ("off_nadir_deg", "off_nadir_azimuth_deg")
"""Settings of a flight that are recorded only if it is tilted."""
_SENSORS = {
    "star_tracker_rate_hz": ("star_tracker_sigma_arcsec", "star_tracker_outages_s"),
    "doppler_rate_hz": ("doppler_beams", "doppler_beam_angle_deg", "doppler_speed_sigma_mps", "doppler_range_sigma_m"),
}
"""Settings of instruments that are recorded only if the instrument's rate, the key, is not 0."""
_OPTIONAL = ("cameras", "hazard", "flash_lidar", "scene", "survey", "counterfactual")
_OTHER: dict[Kind, Kind] = {"detect": "nav", "nav": "detect"}


def recipe_of(config: DatasetConfig, kind: Kind, preset: str, *, planned: bool = False) -> Recipe:
    """The recipe of a dataset; with `planned`, of a plan, with only the versions that affect the ground."""
    with_dem = config.terrain.dem is not None
    versions = (
        ground_versions(with_dem=with_dem)
        if planned
        else all_versions(
            with_dem=with_dem,
            engine=config.render.engine,
            device=device_of(config.render),
            outputs=config.hazard is not None or config.flash_lidar is not None,
        )
    )
    return Recipe(preset=preset, kind=kind, seed=config.seed, config=recorded_settings(config, kind), versions=versions)


def recorded_settings(config: DatasetConfig, kind: Kind) -> dict[str, Any]:
    """The settings recorded in a recipe, as plain data.

    Files are recorded by name, without their folder. Settings that change no byte of the dataset are omitted: settings
    of speed, settings of the other kind unless the kinds share terrain, and optional settings that are not set or not
    used. Settings that the first versions of perilune did not have are omitted if they have their default, so that
    recipes of these versions stay equal.
    """
    plain = json.loads(config.model_dump_json())
    for name in _FILES:
        if plain["terrain"][name] is not None:
            plain["terrain"][name] = Path(plain["terrain"][name]).name
    for name in _SPEED:
        del plain["render"][name]
    for name in _OPTIONAL:
        if not plain[name]:
            del plain[name]
    for camera in (plain["camera"], *plain.get("cameras", {}).values()):
        if camera["focal_length_y_px"] is None:
            del camera["focal_length_y_px"]
        if camera["lens"] is None:
            del camera["lens"]
    for name in SITE_FIELDS:
        if plain["terrain"]["elevation"][name] is None:
            del plain["terrain"]["elevation"][name]
    for name in FILE_FIELDS:
        if plain["terrain"]["elevation"][name] == ElevationConfig.model_fields[name].default:
            del plain["terrain"]["elevation"][name]
    if not config.terrain.elevation.catalogue_columns.stated:
        del plain["terrain"]["elevation"]["catalogue_columns"]
    if config.terrain.catalogue is None:
        del plain["terrain"]["elevation"]["rims"]
    if config.counterfactual is not None and config.counterfactual.depth_share == 0:
        del plain["counterfactual"]["depth_share"]
    if plain["render"]["engine"] == DEFAULT_ENGINE:
        del plain["render"]["engine"]
    plain["render"]["device"] = device_of(config.render)
    for name in ("device", "cycles_device"):
        if plain["render"][name] == "cpu":
            del plain["render"][name]
    for name in _SINCE:
        if plain["sensor"][name] == SensorConfig.model_fields[name].default:
            del plain["sensor"][name]
    if config.scene is not None and not config.scene.horizon:
        del plain["scene"]["horizon"]
    for each in (kind, _OTHER[kind]):
        if not config.kind(each).flight.is_oblique:
            for name in _TILT:
                del plain[each]["flight"][name]
        for rate, names in _SENSORS.items():
            if not plain[each]["instruments"][rate]:
                for name in (rate, *names):
                    del plain[each]["instruments"][name]
    if not config.shared_terrain:
        del plain[_OTHER[kind]]
    return plain


def settings_of(recipe: Recipe) -> dict[str, Any]:
    """The settings of a recipe with a section for each kind.

    If the recipe records only one kind, both sections are equal.
    """
    other = _OTHER[recipe.kind]
    return {other: recipe.config[recipe.kind], **recipe.config} if recipe.kind in recipe.config else recipe.config


def same_source(first: str, second: str) -> bool:
    """Whether two values of `dem_source` have the same content hash; file names are ignored."""
    return first.rpartition("sha256:")[2] == second.rpartition("sha256:")[2]


def config_of(recipe: Recipe, where: object, dem: Path | None = None, catalogue: Path | None = None) -> DatasetConfig:
    """The configuration of a recipe, with the user's copies of the files that the recipe names.

    Recipes are untrusted input: files that they name are never opened, only the user's copies `dem` and `catalogue`.
    Raises UserError if a needed file is not given, if a given file is not used by the recipe, or if this version of
    perilune rejects the settings.
    """
    copies = {"dem": dem, "catalogue": catalogue}
    terrain = recipe.config.get("terrain", {})
    if not isinstance(terrain, dict):
        raise UserError(where, "terrain", repr(terrain), "settings")
    terrain = dict(terrain)
    for name in _FILES:
        if terrain.get(name) is None and copies[name] is not None:
            raise UserError(f"--{name}", name, copies[name], f"no --{name}, since the recipe names no such file")
        if terrain.get(name) is not None:
            if copies[name] is None:
                raise UserError(where, f"terrain.{name}", terrain[name], f"--{name} with a local copy of it")
            terrain[name] = str(copies[name])
    elevation = terrain.get("elevation", {})
    if terrain.get("catalogue") is not None and isinstance(elevation, dict):
        # Recipes older than this setting took all rims from the catalogue.
        terrain["elevation"] = {"rims": "catalogue", **elevation}
    return resolve_over(DatasetConfig, "dataset", str(where), {**settings_of(recipe), "terrain": terrain})
