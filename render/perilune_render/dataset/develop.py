"""Develop a dataset's frames again from their EXRs, with another sensor or another camera at the same place.

Nothing is rendered, so Blender is not needed. An interrupted run is resumed as in rendering: a trajectory is finished
once its part of `frames` is written, which comes last.
"""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow as pa

from perilune_render.config import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.frame import Shot, Studio
from perilune_render.dataset.output import (
    begin_or_go_on,
    first_difference,
    open_finished,
    sync_frames,
    write_overview,
    writing,
)
from perilune_render.flight.plan import camera_of
from perilune_render.imaging.exr import read_radiance
from perilune_render.imaging.sensor import FixedPattern
from perilune_render.labels.frame_labels import Labels, RimCircles
from perilune_render.provenance.recipe import recorded_settings, settings_of
from perilune_render.provenance.versions import imaging_versions
from perilune_shared.config import resolve_over
from perilune_shared.dataset.manifest import Dataset, count_rows, open_dataset
from perilune_shared.dataset.metadata import Counts, DatasetInfo, Origin, Recipe, recipes_of, write_info
from perilune_shared.dataset.parts import write_part
from perilune_shared.dataset.writer import with_column
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.progress import Progress
from perilune_shared.storage import files
from perilune_shared.storage.checksums import seal


def develop_dataset(
    source: Dataset, out: Path, progress: Progress, config_file: Path | None = None, settings: tuple[str, ...] = ()
) -> Dataset:
    """Make a dataset in `out` from the EXRs of `source`, with changes to its settings.

    `config_file` and `settings` may change `dataset.sensor` and `dataset.camera` only. Scenes, craters, boulders and
    trajectories are copied. With the same camera the labels are copied and only their contrast is measured again; with
    another camera all labels are made again. Raises UserError if another setting is changed, if the source is
    incomplete or lacks EXRs, or if the EXRs do not cover the camera's view.
    """
    if len(source.info.recipes) != 1:
        raise UserError(source.root, "recipes", len(source.info.recipes), "one: the dataset as it was rendered")
    old = source.info.recipe()
    config = _changed(source, config_file, settings)
    camera, exr_camera = _cameras(source, config)
    made_of = Origin(
        name=source.info.name,
        sha256=files.sha256_of(source.root / "dataset.json"),
        camera_config=old.config.get("camera", {}),
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
            "camera": source.info.camera.model_copy(update=asdict(camera)),
            "exr_camera": None,
            "recipes": recipes_of(recipe),
            "history": (),
            "counts": Counts(),
        }
    )
    if source.table("frames", ["exr_path"])["exr_path"].null_count:
        raise UserError(source.root, "exr_path", "null", "a dataset rendered with dataset.render.exr=true")
    if source.info.images != "files":
        raise UserError(source.root, "images", source.info.images, "a dataset with its EXRs")
    with writing(out):
        return _develop(source, config, info, (camera, exr_camera), out, progress)


def _develop(
    source: Dataset,
    config: DatasetConfig,
    info: DatasetInfo,
    cameras: tuple[Camera, Camera],
    out: Path,
    progress: Progress,
) -> Dataset:
    """Begin or resume the dataset in `out`; `cameras` are that of its PNGs and that of the source's EXRs."""
    camera, exr_camera = cameras
    info = begin_or_go_on(out, info)
    if info.complete:
        return open_finished(out)
    task = progress.add_task("develop", total=source.info.counts.frames, unit="frames")
    pattern = FixedPattern.draw(config.sensor, camera, config.seed)
    for scene_id in source.scene_ids():
        _copy_scene(source, out, scene_id, info.recipe())
        circles = RimCircles.from_table(source.table("craters", scene_id=scene_id).to_pandas())
        for descent in source.table("trajectories", ["trajectory_id", "seed"], scene_id=scene_id).to_pylist():
            key = {"scene_id": scene_id, "trajectory_id": descent["trajectory_id"]}
            frames = source.table("frames", scene_id=scene_id, trajectory_id=descent["trajectory_id"])
            if not (out / "manifest" / "frames" / f"{'.'.join(key.values())}.parquet").exists():
                sun = np.array(frames["sun_direction"][0].as_py())
                studio = Studio(config, camera, exr_camera, pattern, circles, sun)
                _develop_descent(source, out, studio, key, frames, descent["seed"])
            progress.advance(task, len(frames))
    dataset = Dataset(out, info)
    write_overview(dataset)
    write_info(out, info.model_copy(update={"counts": count_rows(dataset), "complete": True}))
    seal(out)
    return open_dataset(out)


def _changed(source: Dataset, config_file: Path | None, settings: tuple[str, ...]) -> DatasetConfig:
    """The source's settings with the user's changes, which may concern the sensor and the camera only."""
    where = str(source.root / "dataset.json")
    given = settings_of(source.info.recipe())
    before = resolve_over(DatasetConfig, "dataset", where, given)
    after = resolve_over(DatasetConfig, "dataset", where, given, config_file, settings)
    kept = set(DatasetConfig.model_fields) - {"sensor", "camera"}
    theirs, ours = before.model_dump(include=kept), after.model_dump(include=kept)
    if theirs != ours:
        raise UserError(
            "--set or --config",
            "dataset",
            first_difference(theirs, ours),
            "changes of dataset.sensor and dataset.camera alone; all else needs a new rendering",
        )
    return after


def _cameras(source: Dataset, config: DatasetConfig) -> tuple[Camera, Camera]:
    """The camera to develop for, and that of the EXRs, which must cover the view of the first."""
    if not source.info.complete:
        raise UserError(source.root / "dataset.json", "complete", "false", "a finished dataset")
    camera = camera_of(config.camera)
    exr_camera = (source.info.exr_camera or source.info.camera).intrinsics()
    if not exr_camera.covers(camera):
        raise UserError(
            "--set or --config",
            "dataset.camera",
            f"a view that leaves the EXRs' {exr_camera.width_px} x {exr_camera.height_px} px of {exr_camera.fx_px:.6g}"
            " px focal length",
            "a camera whose every pixel the EXRs show",
        )
    return camera, exr_camera


def _develop_descent(
    source: Dataset, out: Path, studio: Studio, key: dict[str, str], frames: pa.Table, seed: int
) -> None:
    """Develop one trajectory: write its images, labels and part of `frames`."""
    known = None
    if studio.camera == source.info.camera.intrinsics():
        table = source.table("labels", scene_id=key["scene_id"], trajectory_id=key["trajectory_id"]).to_pandas()
        known = {frame_id: rows for frame_id, rows in table.groupby("frame_id")}
        none = table.iloc[:0]
    exr_camera = studio.exr_camera
    written: list[dict] = []
    labels = []
    for row in frames.to_pylist():
        size_px = exr_camera.width_px, exr_camera.height_px
        radiance = read_radiance(source.file(row["exr_path"]), size_px)
        shot = Shot.recorded(row, seed)
        png, exposure = studio.write_png(out, shot, radiance)
        written.append(dict(png))
        if known is None:
            found = studio.label(shot, radiance, exposure)
            written[-1]["n_craters_above_max_radius"] = found.n_above
        else:
            found = studio.contrasted(Labels.from_table(known.get(shot.frame_id, none)), shot, exposure)
        labels.append(tables.label_table(shot.frame_id, found))
    name = ".".join(key.values())
    # A run interrupted between the two leaves a labels part without its frames part.
    (out / "manifest" / "labels" / f"{name}.parquet").unlink(missing_ok=True)
    write_part(out, "labels", name, pa.concat_tables(labels))
    sync_frames(out, written)
    write_part(out, "frames", name, tables.developed_frame_table(frames, studio.camera, written))


def _copy_scene(source: Dataset, out: Path, scene_id: str, recipe: Recipe) -> None:
    """Copy the missing parts of a scene; the scene's row gets the new recipe."""
    for name in ("scenes", "craters", "boulders", "trajectories"):
        if not (out / "manifest" / name / f"{scene_id}.parquet").exists():
            rows = source.table(name, scene_id=scene_id)
            if name == "scenes":
                rows = with_column(rows, "recipe", [recipe.key] * len(rows))
            write_part(out, name, scene_id, rows)
