"""Regenerate frames from a manifest alone: seeds, poses and the recorded recipe.

On every processor with AVX2 and FMA, a frame is identical byte for byte. On other processors, rounding may change where
a ray hits the ground and thus single pixels, so frames are compared within a tolerance.
"""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from perilune_render.config.cameras import CameraConfig
from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset.frame_files import write_frame
from perilune_render.dataset.shots import recorded_shot
from perilune_render.dataset.tables import ground_tables
from perilune_render.engines.frame_source import FrameSource
from perilune_render.engines.open_engine import check_engine, open_engine
from perilune_render.flight.pose_checks import Poses, check_poses
from perilune_render.flight.rig import Rig, rig_of
from perilune_render.flight.view import view_of
from perilune_render.imaging.darkness import is_dark, warn_of_dark_frames
from perilune_render.imaging.exr import local_exr, read_exr
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.outputs.of_scene import SceneOutputs
from perilune_render.provenance.recipe import config_of, same_source, settings_of
from perilune_render.terrain.cache import cached_scene
from perilune_shared.config.resolve import resolve_over
from perilune_shared.console.interrupts import interrupts_held
from perilune_shared.console.progress import Progress
from perilune_shared.console.terminal import say
from perilune_shared.content import content_sha256
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import Recipe
from perilune_shared.dataset.names import ImageKind
from perilune_shared.errors import UserError
from perilune_shared.geometry.nominal_trajectory import approach_deg
from perilune_shared.storage.locks import locked
from perilune_shared.storage.png import png_header
from perilune_shared.storage.store import Address, Store, open_store

GREY_TOLERANCE = 2
"""Largest difference of a pixel within tolerance, grey levels on a scale of 255."""
RELATIVE_TOLERANCE = 1e-3
"""Tolerance of EXR values, relative and absolute: `rtol` and `atol` of numpy.isclose."""
OUTLIERS = 0.001
"""Largest share of pixels that may exceed the tolerance, because their rays hit another facet."""
State = Literal["identical", "within tolerance", "different", "new"]
_ORDER: tuple[State, ...] = ("identical", "new", "within tolerance", "different")


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of regenerating one frame."""

    frame_id: str
    """Id in the manifest."""
    png: State
    """Result for the PNG; new if the manifest has no hash."""
    exr: State | None
    """Result for the EXR; None if the frame has no EXR."""
    lidar: State | None
    """Result for the flash lidar image; None if the frame has no such image."""
    same_ground: bool
    """Whether the content hash of craters and boulders equals the hash recorded for the scene."""
    png_path: str
    """Address of the new PNG."""

    @property
    def state(self) -> State:
        """The worst state among the frame's files."""
        return max((state for state in (self.png, self.exr, self.lidar) if state is not None), key=_ORDER.index)


def regenerate(
    dataset: Dataset,
    frame_ids: Sequence[str],
    out: Address,
    progress: Progress,
    dem: Path | None = None,
    catalogue: Path | None = None,
) -> list[Outcome]:
    """Regenerate frames as `out`/frames/<frame_id>.png, .exr and .lidar.exr, and compare them with the manifest.

    `dem` and `catalogue` are the user's copies of the files that the recipes name; a path in a recipe is never opened.
    Raises UserError if a frame is not in the manifest, if this version does not support a recipe, or if `out` holds a
    dataset.
    """
    store = open_store(out)
    if store.exists("dataset.json"):
        raise UserError(store, "--out", "a dataset; its frames would be replaced", "another folder")
    frames = dataset.table("frames")
    known = set(frames["frame_id"].to_pylist())
    for frame_id in frame_ids:
        if frame_id not in known:
            raise UserError(dataset.store, "frame_id", frame_id, f"a frame of the manifest, such as {min(known)}")
    frames = frames.filter(pc.is_in(frames["frame_id"], pa.array(list(frame_ids), pa.string())))
    task = progress.add_task("regenerate", total=len(frames), unit="frames")
    outcomes = []
    with nullcontext() if store.folder is None else locked(store.folder):
        for scene in dataset.table("scenes").sort_by("scene_id").to_pylist():
            rows = frames.filter(pc.equal(frames["scene_id"], scene["scene_id"])).sort_by("frame_id").to_pylist()
            if rows:
                progress.update(task, note=f"{scene['scene_id']}: generating ground")
                sources = _Sources(dem, catalogue)
                outcomes += _of_scene(dataset, scene, rows, store, sources, lambda: progress.advance(task))
    return outcomes


def spread(dataset: Dataset, n_frames: int) -> list[str]:
    """Ids of up to `n_frames` frames, evenly spread over a dataset."""
    ids = sorted(dataset.table("frames", ["frame_id"])["frame_id"].to_pylist())
    return [ids[k] for k in np.unique(np.linspace(0, len(ids) - 1, min(n_frames, len(ids))).round().astype(int))]


@dataclass(frozen=True, slots=True)
class _Sources:
    """The user's copies of the files that a recipe names."""

    dem: Path | None
    """Elevation model; None if the recipe names no model."""
    catalogue: Path | None
    """Crater catalogue; None if the recipe names no catalogue."""


def _of_scene(
    dataset: Dataset, scene: dict, rows: list[dict], out: Store, sources: _Sources, advance: Callable[[], object]
) -> list[Outcome]:
    """Regenerate the frames `rows` of a scene into `out`; `advance` is called after each frame."""
    where = dataset.store.at("dataset.json")
    recipe = dataset.info.recipes.get(scene["recipe"])
    if recipe is None:
        raise UserError(where, "recipes", f"no {scene['recipe']}", f"the recipe of {scene['scene_id']}")
    trajectories = _trajectories(dataset, scene["scene_id"], rows)
    config = config_of(recipe, where, sources.dem, sources.catalogue)
    ground_config = _on_this_machine(_ground_config(recipe, config, where), where)
    rig, exr_rig = rig_of(config), rig_of(ground_config)
    _check_cameras(dataset, rows, rig)
    with interrupts_held():
        ground = cached_scene(ground_config, view_of(ground_config, exr_rig, recipe.kind), scene["seed"])
    if not same_source(ground.dem_source, scene["dem_source"]):
        raise UserError("--dem", "", ground.dem_source, scene["dem_source"])
    of_camera = {name: taken for name in rig if (taken := [row for row in rows if row["camera"] == name])}
    for name, taken in of_camera.items():
        poses = (np.array([row[column] for row in taken]) for column in ("position_m", "rotation_wxyz"))
        ids = [row["frame_id"] for row in taken]
        check_poses(Poses(ids, *poses), exr_rig[name].exr_camera, ground, dataset.store)
    tables = ground_tables(scene["scene_id"], ground)
    same_ground = content_sha256(tables["craters"], tables["boulders"]) == scene["content_sha256"]
    outcomes, dark = [], []
    circles, sun = RimCircles.of_scene(ground), np.array(rows[0]["sun_direction"])
    outputs = SceneOutputs.of(ground, _wanted(config, rows), sun)
    for name, taken in of_camera.items():
        with open_engine(ground, ground_config, exr_rig[name].exr_camera, sun, outputs.surface) as engine:
            source = FrameSource.of(engine, config, rig[name].camera, circles, name)
            for row in taken:
                frame_id, trajectory = row["frame_id"], trajectories[row["trajectory_id"]]
                approach = approach_deg(trajectory["nominal_position_m"])
                frame = source.take(recorded_shot(row, trajectory["seed"], approach))
                # Developed frames have no EXR, although their recipe has dataset.render.exr=true.
                has_exr = row["exr_path"] is not None
                extra = outputs.of_frame(frame, source.places_m)
                new = write_frame(out, frame_id, source, frame, exr=has_exr, outputs=extra)
                png = _compared(dataset, row, "png", out, new)
                exr = _compared(dataset, row, "exr", out, new) if has_exr else None
                lidar = _compared(dataset, row, "lidar", out, new) if row["lidar_path"] is not None else None
                outcomes.append(Outcome(frame_id, png, exr, lidar, same_ground, out.at(str(new["png_path"]))))
                if is_dark(frame.radiance):
                    dark.append(frame_id)
                advance()
    warn_of_dark_frames(scene["scene_id"], dark, len(rows), scene["sun_elevation_deg"])
    return outcomes


def _on_this_machine(config: DatasetConfig, where: str) -> DatasetConfig:
    """The configuration with the device `cpu` if the recipe has another device, which this machine does not have."""
    on_processor = config.render.model_copy(update={"device": "cpu", "cycles_device": "cpu"})
    try:
        check_engine(config.render)
    except UserError:
        if config.render == on_processor:
            raise
        kind = (
            "a CUDA device" if config.render.device == "cuda" else f"a device {config.render.cycles_device} of Cycles"
        )
        say(f"{where}: its frames were rendered on {kind} and are rendered on the processor here: bytes differ")
        check_engine(on_processor)
        return config.model_copy(update={"render": on_processor})
    return config


def _trajectories(dataset: Dataset, scene_id: str, rows: list[dict]) -> dict[str, dict]:
    """Rows of a scene's trajectories by their ids. Raises UserError if a frame of `rows` has no trajectory."""
    columns = ["trajectory_id", "seed", "nominal_position_m"]
    recorded = dataset.table("trajectories", columns, scene_id=scene_id).to_pylist()
    trajectories = {row["trajectory_id"]: row for row in recorded}
    for row in rows:
        if row["trajectory_id"] not in trajectories:
            expected = f"the trajectory of {row['frame_id']}"
            raise UserError(dataset.store, "trajectories", f"no {row['trajectory_id']}", expected)
    return trajectories


def _check_cameras(dataset: Dataset, rows: list[dict], rig: Rig) -> None:
    """Raise UserError if the recorded camera of a frame differs from the recipe's camera."""
    where = dataset.store.at("dataset.json")
    for row in rows:
        if row["camera"] not in rig:
            raise UserError(where, "cameras", row["camera"], f"a camera of its recipe: {', '.join(map(str, rig))}")
        recorded, expected = dataset.camera_of(row), rig[row["camera"]].camera
        if recorded != expected:
            raise UserError(where, "camera", recorded, f"the camera of its recipe, {expected}")


def _wanted(config: DatasetConfig, rows: list[dict]) -> DatasetConfig:
    """The settings, without hazard map and flash lidar if no frame of `rows` has their outputs."""
    has_exrs, has_lidar = (any(row[f"{kind}_path"] is not None for row in rows) for kind in ("exr", "lidar"))
    channels = config.hazard is not None and config.hazard.frame_channels and has_exrs
    hazard, lidar = config.hazard if channels else None, config.flash_lidar if has_lidar else None
    return config.model_copy(update={"hazard": hazard, "flash_lidar": lidar})


def _ground_config(recipe: Recipe, config: DatasetConfig, where: object) -> DatasetConfig:
    """The settings of ground and EXRs. Those of a developed dataset have the camera of its source."""
    origin = recipe.developed_from
    if origin is None:
        return config
    if origin.camera_config is None:
        raise UserError(where, "developed_from", "no camera", "a dataset that records the camera of its source")
    if config.cameras:
        plain = {**settings_of(recipe), "cameras": origin.camera_config}
        return config.model_copy(update={"cameras": resolve_over(DatasetConfig, "dataset", str(where), plain).cameras})
    camera = resolve_over(CameraConfig, "dataset.camera", str(where), origin.camera_config)
    return config.model_copy(update={"camera": camera})


def _compared(dataset: Dataset, row: dict, kind: ImageKind, out: Store, new: dict[str, Any]) -> State:
    """Compare a new file with the recorded hash, then, if the hash differs, with the pixels of an existing old file."""
    if row[f"{kind}_sha256"] is None:
        return "new"
    if new[f"{kind}_sha256"] == row[f"{kind}_sha256"]:
        return "identical"
    try:
        if kind == "png" and dataset.info.images in ("files", "packed"):
            frames = dataset.table("frames", scene_id=row["scene_id"], trajectory_id=row["trajectory_id"])
            old = dict(dataset.pngs(frames.filter(pc.equal(frames["frame_id"], row["frame_id"]))))[row["frame_id"]]
            return _state(png_outlier_share(old, out.read(new["png_path"])))
        if kind != "png" and dataset.info.images == "files":
            path = f"{kind}_path"
            with local_exr(dataset.store, row[path]) as before, local_exr(out, new[path]) as after:
                return _state(exr_outlier_share(read_exr(before), read_exr(after)))
    except UserError:
        pass  # the old file is missing or damaged, and the hash differs
    return "different"


def _state(outlier_share: float) -> State:
    return "within tolerance" if outlier_share <= OUTLIERS else "different"


def png_outlier_share(first: bytes, second: bytes) -> float:
    """Share of the pixels of two PNGs that differ by more than GREY_TOLERANCE; 1 if their shapes differ."""
    try:
        # A small file may decompress to any size, so compare the headers first.
        if png_header(first) != png_header(second):
            return 1.0
    except ValueError:
        return 1.0
    old, new = (cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED) for png in (first, second))
    if old is None or new is None or old.shape != new.shape or old.dtype != new.dtype:
        return 1.0
    scale = 255 / np.iinfo(old.dtype).max
    return float((np.abs(old.astype(float) - new) * scale > GREY_TOLERANCE).mean())


def exr_outlier_share(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> float:
    """Largest share, over the channels, of pixels that differ by more than RELATIVE_TOLERANCE.

    Returns 1 if shapes differ.
    """
    if {k: v.shape for k, v in first.items()} != {k: v.shape for k, v in second.items()}:
        return 1.0
    shares = []
    for name, channel in first.items():
        close = np.isclose(channel, second[name], rtol=RELATIVE_TOLERANCE, atol=RELATIVE_TOLERANCE, equal_nan=True)
        shares.append(1 - float(close.mean()))
    return max(shares, default=1.0)
