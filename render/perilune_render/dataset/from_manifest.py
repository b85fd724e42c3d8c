"""Make a plan from a manifest, to render a published dataset again."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from perilune_render.config.dataset import DatasetConfig, FlightConfig
from perilune_render.dataset.begin import camera_records, new_info
from perilune_render.flight.motion import Motion, draw_motion
from perilune_render.flight.plan import Plan, ScenePlan, TrajectoryPlan
from perilune_render.flight.rig import MountedCamera, Rig, mounted, rig_of
from perilune_render.flight.survey import survey_camera
from perilune_render.flight.trajectories import Flight
from perilune_render.flight.view import view_of
from perilune_render.provenance.recipe import config_of, recipe_of, same_source
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.schema import ANGULAR_VELOCITY
from perilune_shared.errors import UserError
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory
from perilune_shared.storage.files import sha256_of

_SAME_M = 1e-6
"""Largest difference between a recorded and a redrawn position, metres; rounding differs between processors."""
_TURN = "angular_velocity_radps"
_OF_FRAMES = ("frame_index", "split", "time_s", "position_m", "velocity_mps", "rotation_wxyz", "camera")


def plan_from_manifest(
    manifest: Dataset, dem: Path | None = None, catalogue: Path | None = None
) -> tuple[Plan, DatasetConfig, DatasetInfo]:
    """The plan, the settings and the initial dataset.json to render a manifest's frames again.

    Names, seeds, poses and splits come from the manifest; `dem` and `catalogue` are the user's copies of the files that
    its recipe names. Raises UserError if the manifest has several recipes (merged from different datasets), if its
    frames were developed from EXRs, or if the elevation model differs.
    """
    info, where = manifest.info, manifest.store.at("dataset.json")
    if len(info.recipes) != 1:
        expected = "one recipe; select its scenes with `perilune-manifest subset --where \"recipe == '...'\"`"
        raise UserError(where, "recipes", len(info.recipes), expected)
    recipe = info.recipe()
    if recipe.developed_from is not None:
        expected = "a rendered dataset; render its source, then `perilune-render develop`"
        raise UserError(where, "developed_from", recipe.developed_from.name, expected)
    config = config_of(recipe, where, dem, catalogue)
    _check_dem(manifest, config)
    rig: Rig = rig_of(config)
    view = view_of(config, rig, recipe.kind)
    if config.survey is not None:
        rig = {None: mounted(survey_camera(config.survey, float(view.reach_m[-1])))}
    scenes = [
        ScenePlan(row["scene_id"], row["seed"], row["sun_azimuth_deg"], row["sun_elevation_deg"])
        for row in manifest.table("scenes").sort_by("scene_id").to_pylist()
    ]
    recorded = Recorded.of(manifest, [scene.scene_id for scene in scenes], config.kind(recipe.kind).flight, rig)
    rig = _rig_of_frames(manifest, rig)
    of_scene = [row["scene_id"] for row in recorded.rows]
    ranges = {
        scene.scene_id: range(bisect_left(of_scene, scene.scene_id), bisect_right(of_scene, scene.scene_id))
        for scene in scenes
    }
    plan = Plan(rig, view, tuple(scenes), recorded, ranges)
    begun = new_info(config, plan, recipe_of(config, recipe.kind, recipe.preset))
    metadata = {"name": info.name, "split_by": info.split_by, "history": info.history, "licence": info.licence}
    return plan, config, begun.model_copy(update=metadata)


def _rig_of_frames(manifest: Dataset, rig: Rig) -> Rig:
    """The cameras of a rig for which a manifest has frames. Raises UserError if it records other cameras."""
    info, where = manifest.info, manifest.store.at("dataset.json")
    names = set(manifest.table("frames", ["camera"])["camera"].unique().to_pylist())
    if not names <= rig.keys():
        expected = f"the cameras of its recipe, {sorted(map(str, rig))}"
        raise UserError(where, "cameras", sorted(map(str, names)), expected)
    used = {name: each for name, each in rig.items() if name in names}
    for name, each in used.items():
        if (recorded := info.camera_of(name)) != camera_records(each)[0]:
            raise UserError(where, "camera", recorded, f"the camera of its recipe, {camera_records(each)[0]}")
    return used or rig


def _check_dem(manifest: Dataset, config: DatasetConfig) -> None:
    dem = Path(config.terrain.dem) if config.terrain.dem is not None else None
    if dem is None or not dem.is_file():  # a missing file is reported when it is opened
        return
    sha256 = f"sha256:{sha256_of(dem)}"
    for expected in manifest.table("scenes", ["dem_source"])["dem_source"].unique().to_pylist():
        if not same_source(sha256, expected):
            raise UserError("--dem", "", sha256, expected)


@dataclass(frozen=True, slots=True)
class Recorded(Sequence[TrajectoryPlan]):
    """The trajectories of a manifest, ordered by scene and id."""

    rows: list[dict[str, Any]]
    """Rows of the table `trajectories`."""
    first: np.ndarray
    """Index of the first frame of each trajectory, then the total number of frames (n_trajectories + 1,)."""
    columns: dict[str, np.ndarray]
    """Columns of the table `frames`, ordered by trajectory, then by `frame_index`; arrays (n_frames, ...)."""
    settings: FlightConfig | None
    """Settings of the flights, from which the motion between frames is drawn; None if this motion is not needed."""
    rig: Rig
    """Cameras by name; needed only with `settings`."""

    @classmethod
    def of(
        cls,
        manifest: Dataset,
        scene_ids: list[str],
        settings: FlightConfig | None = None,
        rig: Rig | None = None,
    ) -> "Recorded":
        """Read the trajectories and poses of some scenes of a manifest."""
        keys = ["scene_id", "trajectory_id"]
        trajectories = manifest.table("trajectories").sort_by([(key, "ascending") for key in keys])
        trajectories = trajectories.filter(pc.is_in(trajectories["scene_id"], pa.array(scene_ids, pa.string())))
        frames = manifest.table("frames", [*keys, *_OF_FRAMES, *ANGULAR_VELOCITY])
        names, of_frames = (
            pc.binary_join_element_wise(*(table[key] for key in keys), "/") for table in (trajectories, frames)
        )
        if trajectories.num_rows and not frames.num_rows:
            expected = "rows for all frames; restore them with `perilune-render plan --manifest ... --out FOLDER`"
            raise UserError(manifest.store.at("manifest/frames"), "frames", "no rows: they were left out", expected)
        position = pc.fill_null(pc.index_in(of_frames, names), -1).to_numpy()
        order = np.lexsort((frames["frame_index"].to_numpy(), position))[np.count_nonzero(position < 0) :]
        first = np.concatenate([[0], np.cumsum(np.bincount(position[order], minlength=len(names)))])
        columns = {name: _values(frames[name])[order] for name in _OF_FRAMES}
        turn = [frames[name] for name in ANGULAR_VELOCITY]
        if any(each.null_count < len(each) for each in turn):
            columns[_TURN] = np.stack([pc.fill_null(each, 0.0).to_numpy() for each in turn], axis=1)[order]
        return cls(trajectories.to_pylist(), first, columns, settings, rig or {})

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, number: Any) -> Any:
        """The trajectory at an index, or the trajectories of a slice as a tuple."""
        if isinstance(number, slice):
            return tuple(self[k] for k in range(*number.indices(len(self))))
        number = range(len(self))[number]
        row, frames = self.rows[number], slice(self.first[number], self.first[number + 1])
        columns = {name: values[frames] for name, values in self.columns.items()}
        cameras = columns.pop("camera")
        camera = cameras[0] if len(cameras) and isinstance(cameras[0], str) else None
        flight = partial(_flight, row, columns, self.settings, self.rig.get(camera))
        index, splits = tuple(columns["frame_index"].tolist()), tuple(columns["split"].tolist())
        ids = row["scene_id"], row["trajectory_id"]
        return TrajectoryPlan(*ids, row["seed"], index, splits, flight, is_drawn=False, camera=camera)


def _values(column: pa.ChunkedArray) -> np.ndarray:
    """A column without nulls as an array (N,), or (N, k) if it holds lists of k numbers."""
    if pa.types.is_fixed_size_list(column.type):
        return column.combine_chunks().flatten().to_numpy().reshape(-1, column.type.list_size)
    return column.to_numpy()


def _flight(
    row: dict[str, Any], columns: dict[str, np.ndarray], settings: FlightConfig | None, camera: MountedCamera | None
) -> Flight:
    """The flight of a row of the table `trajectories` and the columns of its frames.

    The motion between frames is drawn again from the recorded seed. If it does not pass through the recorded positions,
    the flight has no motion: the recorded poses were given, or were drawn with other settings.
    """
    position, velocity, acceleration = (
        tuple(row[f"nominal_{name}"]) for name in ("position_m", "velocity_mps", "acceleration_mps2")
    )
    nominal = NominalTrajectory(position, velocity, acceleration, row["duration_s"])
    motion = draw_motion(settings, row["seed"]) if settings is not None else None
    if motion is not None and not _passes(motion, columns, camera):
        motion = None
    time, path, speed, rotation = (columns[name] for name in ("time_s", "position_m", "velocity_mps", "rotation_wxyz"))
    return Flight(nominal, time, path, speed, rotation, motion, columns.get(_TURN))


def _passes(motion: Motion, columns: dict[str, np.ndarray], camera: MountedCamera | None) -> bool:
    """Whether a motion of the lander's body passes through the recorded positions of one camera's frames."""
    position = columns["position_m"]
    if camera is not None and camera.position_in_body_m.any():
        position = camera.body_position(position, columns["rotation_wxyz"])
    return np.allclose(motion.path_at(columns["time_s"])[0], position, rtol=0, atol=_SAME_M)


def compare_hashes(manifest: Dataset, rendered: Dataset) -> tuple[int, int, int]:
    """Numbers of frames with equal PNG hashes, frames with a hash in the manifest, and scenes with different ground."""
    old, new = (
        dict(zip(*(d.table("frames", ["frame_id", "png_sha256"]).to_pydict().values()), strict=True))
        for d in (manifest, rendered)
    )
    ground = (
        dict(zip(*(d.table("scenes", ["scene_id", "content_sha256"]).to_pydict().values()), strict=True))
        for d in (manifest, rendered)
    )
    before, after = ground
    known = [name for name, sha256 in old.items() if sha256 is not None]
    same = sum(old[name] == new[name] for name in known)
    return same, len(known), sum(before[name] != after[name] for name in before)
