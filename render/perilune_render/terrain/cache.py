"""Cache of generated scenes, with which another run over the same ground starts immediately.

A scene's file is named by the hash of everything that determines it. The folder is `$PERILUNE_CACHE`, or
`perilune/scenes` in the user's cache folder. Above the size limit the least recently used files are removed. If the
cache cannot be written or a file is damaged, the scene is generated again.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.provenance.caches import cache_home
from perilune_render.provenance.versions import ground_versions
from perilune_render.terrain.boulders import Boulders
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.craters.rims import Rims
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.scene import Scene, grow_scene
from perilune_shared.storage.files import sha256_of, write_bytes, written_aside
from perilune_shared.storage.rasters import raster_files
from perilune_shared.storage.store import Store

_PARTS: dict[str, type] = {"grid": Grid, "craters": Craters, "rims": Rims, "boulders": Boulders}


def cache_folder() -> Path:
    """The folder of the cached scenes."""
    if "PERILUNE_CACHE" in os.environ:
        return Path(os.environ["PERILUNE_CACHE"])
    return cache_home() / "scenes"


def scene_key(config: DatasetConfig, view: ViewEnvelope, seed: int) -> str:
    """Hash of all inputs of a scene: code, libraries, terrain settings, views, seed and files."""
    terrain = config.terrain.model_dump(mode="json")
    for name in ("dem", "catalogue"):
        if terrain[name] is not None and Path(terrain[name]).is_file():
            path = Path(terrain[name])
            files = raster_files(path, tiles=config.terrain.elevation.vrt_files).paths if name == "dem" else (path,)
            terrain[name] = [path.name, *(sha256_of(file) for file in files)]
    terrain.pop("max_vertices")  # limits meshes, and does not change the ground
    terrain["elevation"].pop("citation")
    versions = ground_versions(with_dem=config.terrain.dem is not None)
    content = {
        "versions": {name: version for name, version in versions.items() if not name.startswith("perilune")},
        "terrain": terrain,
        "albedo_variation": config.light.albedo_variation,
        "view": [view.height_m.tolist(), view.reach_m.tolist(), view.focal_px],
        "seed": seed,
        "removed": list(config.removed_from(seed)),
    }
    if view.horizon:
        content["horizon"] = True
    if config.removed_from(seed) and config.depth_share:
        content["depth_share"] = config.depth_share
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def cached_scene(config: DatasetConfig, view: ViewEnvelope, seed: int, shared: Store | None = None) -> Scene:
    """The scene of a seed, read from the cache, or generated and stored there.

    `shared` is a second cache, which other machines use too. A scene that is not in the local cache is read from it,
    and a new scene is also stored in it.
    """
    if config.render.cache_gib == 0:
        return grow_scene(config, view, seed)
    path = cache_folder() / f"{scene_key(config, view, seed)}.npz"
    scene = _read(path, view)
    if scene is None and shared is not None and shared.exists(path.name):
        with contextlib.suppress(OSError):
            write_bytes(path, shared.read(path.name))
        scene = _read(path, view)
    if scene is None:
        scene = grow_scene(config, view, seed)
        with contextlib.suppress(OSError):
            _write(path, scene)
            if shared is not None:
                with contextlib.suppress(FileExistsError):  # another machine was faster
                    shared.write(path.name, path.read_bytes())
            _make_room(path.parent, config.render.cache_gib * 2**30)
    return scene


def _write(path: Path, scene: Scene) -> None:
    arrays: dict[str, Any] = {}
    for field in dataclasses.fields(scene):
        value = getattr(scene, field.name)
        if field.name in _PARTS:
            for part in dataclasses.fields(value):
                arrays[f"{field.name}.{part.name}"] = getattr(value, part.name)
        elif field.name != "view":
            arrays[field.name] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    # np.savez closes its archive a second time, with a traceback, if the disk is full.
    with written_aside(path) as aside, aside.open("wb") as file, zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)


def _read(path: Path, view: ViewEnvelope) -> Scene | None:
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        os.utime(path)
        values = {name: array if array.ndim else array.item() for name, array in arrays.items()}
        parts = {
            name: kind(**{part.name: values.pop(f"{name}.{part.name}") for part in dataclasses.fields(kind)})
            for name, kind in _PARTS.items()
        }
        return Scene(**values, **parts, view=view)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None


def _make_room(folder: Path, most_bytes: float) -> None:
    files = sorted(folder.glob("[0-9a-f]*.npz"), key=lambda path: path.stat().st_mtime, reverse=True)
    total = 0
    for index, path in enumerate(files):
        total += path.stat().st_size
        # The newest file is kept, however large it is.
        if total > most_bytes and index > 0:
            path.unlink(missing_ok=True)
