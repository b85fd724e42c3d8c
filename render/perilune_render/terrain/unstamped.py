"""The scenes that result if craters are removed from one scene, each generated in about a second."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.terrain.albedo import RAYED_WEAR, RayLaw, add_rays, brightness
from perilune_render.terrain.boulders import draw_boulders
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.craters.unstamp import CraterChanges
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import Scene, uncratered_ground
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array


class Unstamped:
    """Generates one scene several times, each time without some of its craters."""

    def __init__(self, scene: Scene, config: DatasetConfig, view: ViewEnvelope, crater_ids: Sequence[int] | np.ndarray):
        """`crater_ids` are the craters of `scene` that may be removed; `scene` has no removed craters.

        Raises UserError if an id does not belong to a generated crater of the scene.
        """
        self._scene, self._config, self._ids = scene, config, np.unique(np.array(crater_ids, np.int64))
        ground = uncratered_ground(config, view, scene.seed)
        self._drawn, soil = ground.drawn, ground.soil
        self._index = _indices(self._drawn, scene.craters, self._ids, scene.seed)
        law, variation = config.terrain.craters, config.light.albedo_variation
        self._rays = RayLaw(law.n_rayed, variation)
        self._ray_light = self._rays_without(None)
        soil.albedo[:] += self._ray_light
        brightening = variation * brightness(self._drawn)
        grounds = soil.height_m, soil.albedo
        self._changes = CraterChanges(grounds, scene.grid, self._drawn, self._index, brightening, law.profile)
        self._albedo = soil.albedo

    def without(self, crater_ids: Sequence[int] | np.ndarray) -> Scene:
        """The scene without some of its craters, with their rays and boulders removed.

        Heights equal the heights of `grow_scene` without these craters, except for rounding to float32. The tables of
        craters and rims still list all craters.
        """
        scene, config = self._scene, self._config
        rows = self._index[np.searchsorted(self._ids, crater_ids)]
        height, albedo = self._changes.without(rows)
        radius = self._drawn.diameter_m[rows] / 2
        if (self._drawn.wear_m2[rows] / radius**2 < RAYED_WEAR).any():
            albedo = albedo + (self._rays_without(rows) - self._ray_light)
        new_m = scene.height_m + height
        removed = np.searchsorted(scene.crater_id, crater_ids)
        boulders = draw_boulders(config.terrain.boulders, scene.grid, scene.craters, scene.seed, removed)
        z_m = boulders.centre_height_m(value_at(new_m, scene.grid, boulders.x_m, boulders.y_m))
        light = np.clip(self._albedo + albedo, 0.5, 2.2).astype(np.float32)
        return replace(scene, height_m=new_m.astype(np.float32), albedo=light, boulders=boulders, boulder_z_m=z_m)

    def _rays_without(self, rows: np.ndarray | None) -> Array:
        """Brightening by the rays of all drawn craters but those at `rows` (n_vertices,)."""
        light = np.zeros(self._scene.grid.n_vertices)
        if self._rays.strength > 0:
            add_rays(light, self._scene.grid, self._drawn, self._rays, self._scene.seed, rows)
        return light


def _indices(drawn: Craters, craters: Craters, crater_ids: np.ndarray, seed: int) -> np.ndarray:
    """Indices in `drawn` (N,) of the craters of a scene with these ids, found by their positions."""
    order = np.lexsort((drawn.y_m, drawn.x_m))
    place = {xy: int(k) for k, xy in zip(order, zip(drawn.x_m[order], drawn.y_m[order], strict=True), strict=True)}
    found = []
    for crater_id in crater_ids.tolist():
        known = 0 <= crater_id < len(craters) and craters.origin[crater_id] != 2
        k = place.get((craters.x_m[crater_id], craters.y_m[crater_id])) if known else None
        if k is None:
            expected = f"generated craters of the scene with seed {seed}"
            raise UserError("detectability", "crater_id", crater_id, expected)
        found.append(k)
    return np.array(found, np.int64)
