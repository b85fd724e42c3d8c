"""Read and write the files of a map: one catalogue per scene, and their stated errors."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_shared.storage.files import write_text
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.fly.catalogue import CatalogueUse, read_catalogue

SETTINGS = "map.json"


@dataclass(frozen=True, slots=True)
class SceneMap:
    """The catalogue of one scene."""

    scene_id: str
    """The scene."""
    catalogue: Catalogue
    """Craters, largest first."""
    score: Array
    """Scores of the craters (N,)."""
    errors: pd.DataFrame
    """Errors of the catalogue by diameter."""
    picture: NDArray[np.uint8]
    """Centre of the first image, with the mapped craters drawn."""


def write_maps(folder: Path, dataset: Dataset, maps: list[SceneMap]) -> None:
    """Write <scene_id>.parquet for each scene, and map.json.

    For each scene, map.json has the stated errors, the position of the Sun and the hash of the terrain.
    """
    columns = ["scene_id", "sun_azimuth_deg", "sun_elevation_deg", "content_sha256"]
    by_scene = dataset.table("scenes", columns).to_pandas().set_index("scene_id").to_dict("index")
    scenes = {}
    for scene_map in maps:
        craters = {f"{axis}_m": scene_map.catalogue.centre_m[:, axis_number] for axis_number, axis in enumerate("xyz")}
        craters |= {"diameter_m": 2 * scene_map.catalogue.radius_m, "score": scene_map.score}
        pd.DataFrame(craters).to_parquet(folder / f"{scene_map.scene_id}.parquet", index=False)
        scenes[scene_map.scene_id] = {
            "craters": len(scene_map.catalogue),
            "position_sigma_m": round(scene_map.catalogue.position_sigma_m, 4),
            "diameter_sigma_share": scene_map.catalogue.radius_sigma_share,
            **by_scene[scene_map.scene_id],
        }
    write_text(folder / SETTINGS, json.dumps({"dataset": dataset.info.name, "scenes": scenes}, indent=2) + "\n")


def read_maps(folder: Path, dataset: Dataset) -> dict[str, Catalogue]:
    """Read the catalogues that `write_maps` wrote, by scene_id.

    Scenes that are missing from the map or from the dataset are left out. Raises UserError if map.json or a catalogue
    is damaged, if map and dataset have no scene in common, or if the terrain of a scene differs between them.
    """
    path, expected = folder / SETTINGS, "the folder of a map, from `perilune-train navigate map`"
    try:
        scenes = json.loads(path.read_text(encoding="utf-8"))["scenes"]
        sigmas = {str(name): _sigmas(record) for name, record in scenes.items()}
        hashes = {str(name): str(record["content_sha256"]) for name, record in scenes.items()}
    except OSError:
        raise UserError(path, "map", "no such file", expected) from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(path, "map", repr(error), expected) from None
    hash_of_scene = dict(
        zip(*dataset.table("scenes", ["scene_id", "content_sha256"]).to_pydict().values(), strict=True)
    )
    shared = sorted(set(hash_of_scene) & set(sigmas))
    if not shared:
        raise UserError(path, "scenes", sorted(sigmas)[:3], f"scenes of {dataset.store}")
    for name in shared:
        if hashes[name] != hash_of_scene[name]:
            raise UserError(
                path, f"{name}: content_sha256", hashes[name], f"{hash_of_scene[name]}, the ground of the dataset"
            )
    # Security: only scene names from the dataset are used as file names.
    return {name: read_catalogue(folder / f"{name}.parquet", CatalogueUse(*sigmas[name])) for name in shared}


def _sigmas(record: dict[str, float]) -> tuple[float, float]:
    """Stated standard deviations of position and diameter; ValueError unless finite and at least 0."""
    values = float(record["position_sigma_m"]), float(record["diameter_sigma_share"])
    if not all(0 <= value < 1e3 for value in values):
        raise ValueError(f"deviations {values}, expected 0 to 1000")
    return values
