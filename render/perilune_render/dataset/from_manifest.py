"""The plan of a manifest, so that a published dataset can be rendered again with its labels."""

from pathlib import Path

import numpy as np

from perilune_render.config import DatasetConfig
from perilune_render.dataset.folder import new_info
from perilune_render.flight.plan import Plan, ScenePlan, TrajectoryPlan, camera_of
from perilune_render.flight.trajectories import Flight
from perilune_render.flight.view import view_envelope
from perilune_render.provenance.recipe import config_of, recipe_of, same_source
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.errors import UserError
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory
from perilune_shared.storage.files import sha256_of


def plan_from_manifest(
    manifest: Dataset, dem: Path | None = None, catalogue: Path | None = None
) -> tuple[Plan, DatasetConfig, DatasetInfo]:
    """The plan of a manifest's scenes, trajectories and frames, its settings, and the initial dataset.json.

    Names, seeds, poses and splits come from the manifest; `dem` and `catalogue` are the user's copies of the files that
    its recipe names. Raises UserError if the manifest has several recipes (merged from different datasets), if its
    frames were developed again, or if the elevation model differs.
    """
    info, where = manifest.info, manifest.root / "dataset.json"
    if len(info.recipes) != 1:
        expected = "one recipe; select its scenes with `perilune-manifest subset --where \"recipe == '...'\"`"
        raise UserError(where, "recipes", len(info.recipes), expected)
    recipe = info.recipe()
    if recipe.developed_from is not None:
        expected = "a rendered dataset; render its source, then `perilune-render develop`"
        raise UserError(where, "developed_from", recipe.developed_from.name, expected)
    config = config_of(recipe, where, dem, catalogue)
    _check_dem(manifest, config)
    camera = camera_of(config.camera)
    if camera != info.camera.intrinsics():
        raise UserError(where, "camera", info.camera.intrinsics(), f"that of its recipe, {camera}")
    scenes = [
        ScenePlan(row["scene_id"], row["seed"], row["sun_azimuth_deg"], row["sun_elevation_deg"])
        for row in manifest.table("scenes").sort_by("scene_id").to_pylist()
    ]
    trajectories = [trajectory for scene in scenes for trajectory in _trajectories(manifest, scene.scene_id)]
    exr_camera = camera.covering_pinhole()
    view = view_envelope(exr_camera, config.ground_flight(recipe.kind))
    plan = Plan(camera, exr_camera, view, tuple(scenes), tuple(trajectories))
    begun = new_info(config, plan, recipe_of(config, recipe.kind, recipe.preset))
    kept = {"name": info.name, "split_by": info.split_by, "history": info.history, "licence": info.licence}
    return plan, config, begun.model_copy(update=kept)


def _check_dem(manifest: Dataset, config: DatasetConfig) -> None:
    dem = Path(config.terrain.dem) if config.terrain.dem is not None else None
    if dem is None or not dem.is_file():  # reported when it is opened
        return
    found = f"sha256:{sha256_of(dem)}"
    for expected in manifest.table("scenes", ["dem_source"])["dem_source"].unique().to_pylist():
        if not same_source(found, expected):
            raise UserError("--dem", "elevation model", found, expected)


def _trajectories(manifest: Dataset, scene_id: str) -> list[TrajectoryPlan]:
    found = []
    for row in manifest.table("trajectories", scene_id=scene_id).sort_by("trajectory_id").to_pylist():
        frames = manifest.table("frames", scene_id=scene_id, trajectory_id=row["trajectory_id"])
        columns = frames.sort_by("frame_index").to_pydict()
        position, velocity, acceleration = (
            tuple(row[f"nominal_{name}"]) for name in ("position_m", "velocity_mps", "acceleration_mps2")
        )
        flight = Flight(
            NominalTrajectory(position, velocity, acceleration, row["duration_s"]),
            *(np.array(columns[name]) for name in ("time_s", "position_m", "velocity_mps", "rotation_wxyz")),
        )
        places, splits = tuple(columns["frame_index"]), tuple(columns["split"])
        found.append(TrajectoryPlan(scene_id, row["trajectory_id"], row["seed"], places, splits, flight))
    return found


def compare_hashes(manifest: Dataset, made: Dataset) -> tuple[int, int, int]:
    """Numbers of frames with equal hashes, of frames with a hash in the manifest, and of scenes with other ground."""
    old, new = (
        dict(zip(*(d.table("frames", ["frame_id", "png_sha256"]).to_pydict().values()), strict=True))
        for d in (manifest, made)
    )
    ground = (
        dict(zip(*(d.table("scenes", ["scene_id", "content_sha256"]).to_pydict().values()), strict=True))
        for d in (manifest, made)
    )
    before, after = ground
    known = [name for name, sha256 in old.items() if sha256 is not None]
    same = sum(old[name] == new[name] for name in known)
    return same, len(known), sum(before[name] != after[name] for name in before)
