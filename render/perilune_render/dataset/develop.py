"""Develop a dataset's frames again from their EXRs, with another sensor, or another camera at the same position.

Nothing is rendered, so Blender is not needed. A run that was interrupted resumes with the first trajectory without a
commit (`dataset/work.py`).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.begin import begin_or_resume, first_difference, open_finished, writing
from perilune_render.dataset.finish import finish
from perilune_render.dataset.frame_files import write_frame
from perilune_render.dataset.shots import recorded_shot
from perilune_render.dataset.work import OF_SCENE, commit, committed, write_scene
from perilune_render.engines.frame_source import FrameSource
from perilune_render.flight.rig import Rig, rig_of
from perilune_render.flight.sub_poses import RowPoses
from perilune_render.imaging.exr import local_exr, read_radiance
from perilune_render.imaging.radiance import Radiance
from perilune_render.labels.frame_labels import Labels, RimCircles
from perilune_render.provenance.recipe import recorded_settings, settings_of
from perilune_render.provenance.versions import imaging_versions
from perilune_shared.config.resolve import resolve_over
from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import Counts, DatasetInfo, Origin, Recipe, fields_of, recipes_of
from perilune_shared.dataset.names import SCENE_FILE_KINDS
from perilune_shared.dataset.schema import OPTIONAL_TABLES
from perilune_shared.editing.writer import with_column
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_shared.storage.store import Address, Store, open_store


@dataclass(frozen=True, slots=True)
class Renderings:
    """Engine that reads the EXRs of one trajectory instead of rendering."""

    camera: Camera
    """Camera of the EXRs."""
    sun: Array
    """Unit vector towards the Sun, O_L (3,)."""
    store: Store
    """Dataset that holds the EXRs."""
    paths: dict[int, str]
    """Path of each frame's EXR, by the random seed of its rendering."""

    @classmethod
    def of(cls, source: Dataset, frames: pa.Table, seed: int, camera: Camera) -> "Renderings":
        """The EXRs of one trajectory, from its rows of the table `frames` and its random seed."""
        rows = frames.to_pylist()
        paths = {recorded_shot(row, seed).render_seed: row["exr_path"] for row in rows}
        return cls(camera, np.array(rows[0]["sun_direction"]), source.store, paths)

    def render(self, position_m: Array, rotation_camera_from_site: Array, seed: int, approach_deg: int = 0) -> Radiance:
        """Read the EXR that was rendered with a random seed.

        Raises UserError if the file is damaged or has another image size.
        """
        with local_exr(self.store, self.paths[seed]) as path:
            return read_radiance(path, (self.camera.width_px, self.camera.height_px))

    def render_rows(self, poses: RowPoses, seed: int, approach_deg: int = 0) -> Radiance:
        """Read the EXR that was rendered with a random seed, with a pose for each row."""
        return self.render(*poses.pose_at(0.0), seed, approach_deg)


def develop_dataset(
    source: Dataset, out: Address, progress: Progress, config_file: Path | None = None, settings: tuple[str, ...] = ()
) -> Dataset:
    """Make a dataset at `out` from the EXRs of `source`, with changed settings.

    `config_file` and `settings` may change only `dataset.sensor`, `dataset.camera` and the intrinsics in
    `dataset.cameras`. Scenes, craters, boulders and trajectories are copied. With the same camera the labels are copied
    and only their contrast is measured again. With another camera all labels are computed again. Raises UserError if
    another setting is changed, if the source is incomplete or lacks EXRs, or if the EXRs do not cover the camera's
    view.
    """
    if len(source.info.recipes) != 1:
        raise UserError(source.store, "recipes", len(source.info.recipes), "one recipe (a dataset that was not merged)")
    old = source.info.recipe()
    config = _changed(source, config_file, settings)
    rig = _rig(source, config)
    made_of = Origin(
        name=source.info.name,
        sha256=source.store.sha256("dataset.json"),
        camera_config=old.config.get("cameras") or old.config.get("camera", {}),
    )
    recipe = old.model_copy(
        update={
            "config": recorded_settings(config, old.kind),
            "versions": {**old.versions, **imaging_versions()},
            "developed_from": made_of,
        }
    )
    info = source.info.model_copy(
        update={
            "name": f"{source.info.name}-developed",
            "complete": False,
            "images": "files",
            **_records(source, rig),
            "exr_camera": None,
            "exr_cameras": None,
            "recipes": recipes_of(recipe),
            "history": (),
            "counts": Counts(),
            "index": (),
        }
    )
    if source.table("frames", ["exr_path"])["exr_path"].null_count:
        raise UserError(source.store, "exr_path", "null", "a dataset rendered with dataset.render.exr=true")
    if source.info.images != "files":
        raise UserError(source.store, "images", source.info.images, "a dataset with its EXRs")
    store = open_store(out)
    with writing(store):
        return _develop(source, config, info, rig, store, progress)


def _develop(
    source: Dataset,
    config: DatasetConfig,
    info: DatasetInfo,
    rig: Rig,
    out: Store,
    progress: Progress,
) -> Dataset:
    """Begin or resume the dataset at `out`; `rig` holds the cameras of its PNGs."""
    info = begin_or_resume(out, info)
    if info.complete:
        return open_finished(out)
    done, scenes = committed(out), []
    task = progress.add_task("develop", total=source.info.counts.frames, unit="frames")
    for scene_id in source.scene_ids():
        _copy_scene(source, out, scene_id, info.recipe())
        circles = RimCircles.from_table(source.table("craters", scene_id=scene_id).to_pandas())
        trajectories = source.table("trajectories", ["trajectory_id", "seed"], scene_id=scene_id).to_pylist()
        scenes.append((scene_id, [trajectory["trajectory_id"] for trajectory in trajectories]))
        for trajectory in trajectories:
            frames = source.table("frames", scene_id=scene_id, trajectory_id=trajectory["trajectory_id"])
            if f"{scene_id}.{trajectory['trajectory_id']}" not in done:
                name = frames["camera"][0].as_py()
                exr_camera = source.info.exr_camera_of(name).intrinsics()
                renderings = Renderings.of(source, frames, trajectory["seed"], exr_camera)
                frame_source = FrameSource.of(renderings, config, rig[name].camera, circles, name)
                _develop_trajectory(source, out, frame_source, frames, trajectory["seed"])
            progress.advance(task, len(frames))
    return finish(out, info, scenes)


def _changed(source: Dataset, config_file: Path | None, settings: tuple[str, ...]) -> DatasetConfig:
    """The source's settings with the user's changes, which may affect only the sensor and the camera."""
    where = str(source.store.at("dataset.json"))
    source_settings = settings_of(source.info.recipe())
    before = resolve_over(DatasetConfig, "dataset", where, source_settings)
    after = resolve_over(DatasetConfig, "dataset", where, source_settings, config_file, settings)
    fixed_fields = set(DatasetConfig.model_fields) - {"sensor", "camera", "cameras"}
    fixed_before, fixed_after = before.model_dump(include=fixed_fields), after.model_dump(include=fixed_fields)
    for fixed, config in ((fixed_before, before), (fixed_after, after)):
        fixed["cameras"] = {name: camera.mounting.model_dump() for name, camera in config.cameras.items()}
    if fixed_before != fixed_after:
        raise UserError(
            "--set or --config",
            "dataset",
            first_difference(fixed_before, fixed_after),
            "changes to dataset.sensor and dataset.camera only; other changes need a new rendering",
        )
    for name, rendered in (("row_time_s", before.sensor.row_time_s), ("blur_poses", 1)):
        if getattr(after.sensor, name) != rendered:
            expected = f"{rendered:g}, since an EXR has no other poses"
            raise UserError("--set or --config", f"dataset.sensor.{name}", getattr(after.sensor, name), expected)
    if before.sensor.row_time_s and before.camera != after.camera:
        expected = "the camera of the EXRs, whose rows have their own poses"
        raise UserError("--set or --config", "dataset.camera", "another camera", expected)
    return after


def _rig(source: Dataset, config: DatasetConfig) -> Rig:
    """The cameras of the new frames. Raises UserError if the EXRs do not cover a camera's view."""
    if not source.info.complete:
        raise UserError(source.store.at("dataset.json"), "complete", "false", "a finished dataset")
    rig = rig_of(config)
    for name in source.table("frames", ["camera"])["camera"].unique().to_pylist():
        if name not in rig:
            raise UserError(source.store.at("dataset.json"), "cameras", name, "a camera of its recipe")
        exr_camera = source.info.exr_camera_of(name).intrinsics()
        camera = rig[name].camera
        if camera != exr_camera and (camera.lens is not None or exr_camera.lens is not None):
            found = f"a camera of the model {camera.model} that differs from the camera of the EXRs, {exr_camera.model}"
            expected = "the camera of the EXRs; a lens model needs a new rendering"
            raise UserError("--set or --config", "dataset.camera.lens", found, expected)
        if not exr_camera.covers(camera):
            raise UserError(
                "--set or --config",
                "dataset.camera" if name is None else f"dataset.cameras.{name}",
                f"a view that the EXRs ({exr_camera.width_px} x {exr_camera.height_px} px, focal length"
                f" {exr_camera.fx_px:.6g} px) do not cover",
                "a view that the EXRs cover",
            )
    return rig


def _records(source: Dataset, rig: Rig) -> dict[str, Any]:
    """The fields `camera` and `cameras` of dataset.json, with the intrinsics of a rig's cameras."""
    info = source.info
    if info.cameras is None:
        (name,) = source.table("frames", ["camera"])["camera"].unique().to_pylist()
        return {"camera": info.camera.model_copy(update=fields_of(rig[name].camera))}
    cameras = {n: each.model_copy(update=fields_of(rig[n].camera)) for n, each in info.cameras.items()}
    return {"camera": next(iter(cameras.values())), "cameras": cameras}


def _develop_trajectory(source: Dataset, out: Store, frame_source: FrameSource, frames: pa.Table, seed: int) -> None:
    """Develop one trajectory, given its rows of the source's table `frames` and its random seed."""
    scene_id, trajectory_id = (frames[name][0].as_py() for name in ("scene_id", "trajectory_id"))
    known = None
    if frame_source.camera == source.info.camera_of(frames["camera"][0].as_py()).intrinsics():
        known = source.table("labels", scene_id=scene_id, trajectory_id=trajectory_id)
    written: list[dict] = []
    labels = []
    for row in frames.to_pylist():
        frame_id, frame = row["frame_id"], frame_source.take(recorded_shot(row, seed))
        written.append(dict(write_frame(out, frame_id, frame_source, frame, exr=False)))
        if known is None:
            developed = frame_source.labels(frame)
            written[-1]["n_craters_above_max_radius"] = developed.n_above
            labels.append(tables.label_table(frame_id, developed))
        else:
            of_frame = known.filter(pc.equal(known["frame_id"], frame_id))
            developed = frame_source.with_contrast(Labels.from_table(of_frame.to_pandas()), frame)
            labels.append(with_column(of_frame, "contrast", developed.contrast))
    rows = tables.developed_frame_table(frames, frame_source.camera, written)
    keys = {"scene_id": scene_id, "trajectory_id": trajectory_id}
    measurements = {name: source.table(name, **keys) for name in OPTIONAL_TABLES if source.parts(name)}
    commit(out, labels, rows, measurements)


def _copy_scene(source: Dataset, out: Store, scene_id: str, recipe: Recipe) -> None:
    """Copy the rows of a scene; the row in `scenes` gets the new recipe and no files."""
    rows = {name: source.table(name, scene_id=scene_id) for name in OF_SCENE}
    rows["scenes"] = with_column(rows["scenes"], "recipe", [recipe.key] * len(rows["scenes"]))
    for name in (f"{kind}_{column}" for kind in SCENE_FILE_KINDS for column in ("path", "sha256", "bytes")):
        rows["scenes"] = with_column(rows["scenes"], name, [None] * len(rows["scenes"]))
    write_scene(out, scene_id, rows)
