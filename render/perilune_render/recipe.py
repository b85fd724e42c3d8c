"""The recipe that a dataset records, and the way back from it to a configuration."""

import json
from importlib import metadata
from pathlib import Path

import perilune_render
import perilune_shared
from perilune_render.config import DatasetConfig
from perilune_render.terrain.cache import generator
from perilune_shared.config import resolve_over
from perilune_shared.errors import UserError
from perilune_shared.info import Recipe
from perilune_shared.schema import Kind

_FILES = ("dem", "catalogue")


def versions() -> dict[str, str]:
    """Of everything that a frame's bytes depend on."""
    return {
        "perilune_render": perilune_render.__version__,
        "perilune_shared": perilune_shared.__version__,
        "blender": metadata.version("bpy"),
        "numpy": metadata.version("numpy"),
        "generator": generator()[:16],
    }


def recipe_of(config: DatasetConfig, kind: Kind, preset: str) -> Recipe:
    """What a dataset is made by. Of files only the names are kept: their folders are nobody else's business."""
    plain = json.loads(config.model_dump_json())
    for name in _FILES:
        if plain["terrain"][name] is not None:
            plain["terrain"][name] = Path(plain["terrain"][name]).name
    return Recipe(preset=preset, kind=kind, seed=config.seed, config=plain, versions=versions())


def same_source(first: str, second: str) -> bool:
    """Whether two scenes' `dem_source` are of one content, whatever the file was called."""
    return first.rpartition("sha256:")[2] == second.rpartition("sha256:")[2]


def config_of(recipe: Recipe, where: object, dem: Path | None = None, catalogue: Path | None = None) -> DatasetConfig:
    """The configuration of a recipe, with the user's own copies of the files that it names.

    A recipe may be anybody's: the files that it names are never opened, only those given here. Raises UserError where
    one is needed and not given, or the configuration is none of this version.
    """
    given = {"dem": dem, "catalogue": catalogue}
    terrain = recipe.config.get("terrain", {})
    if not isinstance(terrain, dict):
        raise UserError(where, "terrain", repr(terrain), "settings")
    terrain = dict(terrain)
    for name in _FILES:
        if terrain.get(name) is None and given[name] is not None:
            raise UserError(f"--{name}", name, given[name], "no such option: the recipe is of procedural ground")
        if terrain.get(name) is not None:
            if given[name] is None:
                raise UserError(where, f"terrain.{name}", terrain[name], f"--{name} with this machine's copy of it")
            terrain[name] = str(given[name])
    return resolve_over(DatasetConfig, "dataset", str(where), {**recipe.config, "terrain": terrain})
