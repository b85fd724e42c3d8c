"""The folder of a dataset that is rendered or developed: begin it, resume it, finish it."""

import contextlib
from pathlib import Path

import numpy as np
import pyarrow as pa

from perilune_render.config import DatasetConfig
from perilune_render.dataset.overview import write_overview
from perilune_render.flight.plan import Plan, TrajectoryPlan
from perilune_render.provenance.versions import all_versions
from perilune_shared.dataset.index import frame_rows, index_rows, seal
from perilune_shared.dataset.info_file import write_info
from perilune_shared.dataset.manifest import Dataset, count_rows, open_dataset
from perilune_shared.dataset.metadata import CameraRecord, Counts, DatasetInfo, Recipe, recipes_of
from perilune_shared.dataset.parts import Written, read_part
from perilune_shared.dataset.schema import SCHEMA_VERSION, TABLES
from perilune_shared.errors import UserError
from perilune_shared.storage.locks import LOCK_NAME, TEMPORARY_FILE, locked

LICENCE = "CC-BY-4.0"
_SAME_PLACE_M = 1e-6


def new_info(config: DatasetConfig, plan: Plan, recipe: Recipe) -> DatasetInfo:
    """The dataset.json of a new dataset."""
    settings = config.kind(recipe.kind)
    split_by = settings.split_by
    if split_by == "scene" and config.terrain.dem is not None and settings.n_scenes > 1:
        split_by = "trajectory"  # all scenes show the same elevation model
    return DatasetInfo(
        name=f"perilune-{config.name}-{recipe.kind}",
        kind=recipe.kind,
        schema_version=SCHEMA_VERSION,
        complete=False,
        images="files",
        split_by=split_by,
        camera=CameraRecord.of(plan.camera),
        exr_camera=CameraRecord.of(plan.exr_camera) if config.render.exr else None,
        recipes=recipes_of(recipe),
        counts=Counts(),
        licence=LICENCE,
    )


def writing(out: Path) -> contextlib.AbstractContextManager[None]:
    """The lock of a dataset's folder; no lock for a finished dataset, which may be on a read-only disk."""
    is_finished = (out / "dataset.json").exists() and open_dataset(out).info.complete
    return contextlib.nullcontext() if is_finished else locked(out)


def is_begun(out: Path) -> bool:
    """Whether a folder holds a dataset. Raises UserError if it holds something else."""
    others = [path for path in (out.iterdir() if out.exists() else ()) if not _is_temporary(path.name)]
    # Checked last, since another process may be beginning the same dataset; it writes dataset.json first.
    begun = (out / "dataset.json").exists()
    if others and not begun:
        expected = "an empty or new folder, or a dataset to resume"
        raise UserError(out, "--out", "a folder with other content", expected)
    return begun


def _is_temporary(name: str) -> bool:
    return name.startswith(LOCK_NAME) or TEMPORARY_FILE.fullmatch(name) is not None


def begin_or_resume(out: Path, info: DatasetInfo) -> DatasetInfo:
    """Write the dataset.json of a new dataset, or read that of an existing one with the same settings.

    Raises UserError if `out` holds anything else.
    """
    if not is_begun(out):
        write_info(out, info)
    existing = open_dataset(out).info
    if len(existing.recipes) != 1 or existing.history != info.history:
        raise UserError(out, "--out", f"a dataset with other recipes or history: {existing.name}", "another folder")
    if existing.images != info.images:
        raise UserError(out, "--out", f"a dataset whose frames are {existing.images}", "another folder")
    for name in ("kind", "config", "versions", "developed_from"):
        recorded, requested = (_compared(each.recipe(), name) for each in (existing, info))
        if recorded != requested:
            raise UserError(
                out / "dataset.json",
                name,
                first_difference(recorded, requested),
                "the settings that this dataset was started with, or another --out",
            )
    return existing


def check_code(recipe: Recipe, *, with_dem: bool) -> None:
    """Raises UserError if code or libraries of this process are not those of a recipe."""
    recorded, found = (_without_releases(versions) for versions in (recipe.versions, all_versions(with_dem=with_dem)))
    if recorded != found:
        expected = "the code that the rendering began with: render with one version from start to end"
        raise UserError("perilune_render", "versions", first_difference(recorded, found), expected)


def check_begun(out: Path, plan: Plan) -> None:
    """Raises UserError if trajectories that the dataset already holds differ from those of the plan to resume.

    Two manifests with the same settings may still differ in trajectories, frames and splits.
    """
    planned: dict[str, TrajectoryPlan] = {}
    of_scene = None
    for part in sorted(out.joinpath("manifest", "frames").glob("[A-Za-z0-9]*.parquet")):
        scene_id = part.stem.partition(".")[0]
        if scene_id != of_scene:
            of_scene, planned = scene_id, {f"{scene_id}.{t.trajectory_id}": t for t in plan.of_scene(scene_id)}
        own = planned.get(part.stem)
        rows = read_part(part, "frames", ["frame_index", "split", "position_m"])
        if (
            own is None
            or rows["frame_index"].to_pylist() != list(own.frame_index)
            or rows["split"].to_pylist() != list(own.splits)
            or not np.allclose(rows["position_m"].to_pylist(), own.flight.position_m, rtol=0, atol=_SAME_PLACE_M)
        ):
            raise UserError(part, "frames", "those of another plan", "the manifest that the dataset was started with")
    for part in sorted(out.joinpath("manifest", "trajectories").glob("[A-Za-z0-9]*.parquet")):
        found = read_part(part, "trajectories", ["trajectory_id", "seed", "n_frames", "split"]).to_pydict()
        expected = [(t.trajectory_id, t.seed, len(t.splits), t.split) for t in plan.of_scene(part.stem)]
        if list(zip(*found.values(), strict=True)) != expected:
            raise UserError(
                part, "trajectories", "those of another plan", "the manifest that the dataset was started with"
            )


def finish(out: Path, info: DatasetInfo) -> Dataset:
    """Complete a dataset whose parts are all written: write overview, index, counts."""
    dataset = Dataset(out, info)
    write_overview(dataset)
    rows = [frame_rows(dataset.table("frames")), _rows_of_files(dataset)]
    finished = info.model_copy(update={"counts": count_rows(dataset), "complete": True})
    seal(dataset.store, finished, pa.concat_tables(rows))
    return open_dataset(out)


def _rows_of_files(dataset: Dataset) -> pa.Table:
    """The rows of the index of overview and parts, which are read again."""
    paths = ["overview.png", *(path for table in TABLES for path in dataset.parts(table))]
    return index_rows(Written.of(path, dataset.store.read(path)) for path in paths if dataset.store.exists(path))


def _compared(recipe: Recipe, name: str) -> object:
    """One field of a recipe as it is compared on resuming."""
    return _without_releases(recipe.versions) if name == "versions" else getattr(recipe, name)


def _without_releases(versions: dict[str, str]) -> dict[str, str]:
    """Versions without perilune's release numbers, since hashes identify its code."""
    return {name: version for name, version in versions.items() if not name.startswith("perilune")}


def first_difference(recorded: object, requested: object, path: str = "") -> str:
    """The first setting, in order of names, in which two trees of plain data differ, with both values."""
    if isinstance(recorded, dict) and isinstance(requested, dict):
        for key in sorted({*recorded, *requested}):
            if recorded.get(key) != requested.get(key):
                return first_difference(recorded.get(key), requested.get(key), f"{path}.{key}".lstrip("."))
    return f"{path} {requested!r} in place of the recorded {recorded!r}".strip()
