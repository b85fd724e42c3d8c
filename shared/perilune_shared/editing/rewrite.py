"""Write a changed copy of a dataset, for all commands that change or select rows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pyarrow.compute as pc

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.dataset.keys import check_keys
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.names import ImageMode, ImageState
from perilune_shared.dataset.schema import OPTIONAL_TABLES
from perilune_shared.editing.writer import SceneTables, new_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address, Store, open_store
from perilune_shared.validation.files import check_files

_DERIVED_TABLES = ("craters", "boulders", "labels", *OPTIONAL_TABLES)


@dataclass(frozen=True, slots=True)
class Rewriting:
    """How a dataset is rewritten."""

    info: DatasetInfo
    """Content of the new dataset.json; `counts` and `images` are replaced."""
    change: Callable[[SceneTables], SceneTables]
    """Returns the new tables of a scene from the old ones."""
    images: ImageMode
    """How frames are written; see `ImageMode`."""
    scene_ids: Sequence[str] | None = None
    """Scenes to write; None for all."""


def rewrite(source: Dataset, out: Address, rewriting: Rewriting, progress: Progress = NO_PROGRESS) -> None:
    """Write the changed scenes of `source` as a new dataset `out`.

    Scenes and labels without frames are omitted. The caller must have checked the source (`check_source`).
    """
    images = rewriting.images
    info = rewriting.info.model_copy(update={"images": state_of([source], images)})
    scene_ids = source.scene_ids() if rewriting.scene_ids is None else rewriting.scene_ids
    task = progress.add_task("writing", total=len(scene_ids), unit="scenes")
    with new_dataset(out, info) as writer:
        for scene_id in scene_ids:
            tables = rewriting.change(source.scene(scene_id))
            frames = tables["frames"]
            if len(frames):
                of_frames = pc.is_in(tables["labels"]["frame_id"], frames["frame_id"].combine_chunks())
                tables = {**tables, "labels": tables["labels"].filter(of_frames)}
                writer.add_scene(without_derived_rows(tables) if info.images == "planned" else tables)
                if info.images == "files":
                    names = {name: name for name in frames["frame_id"].to_pylist()}
                    writer.add_images(source, frames, names, link=images == "link")
                    writer.add_scene_files(source, tables["scenes"], scene_id, link=images == "link")
            progress.advance(task)


def check_source(source: Dataset, out: Address, progress: Progress = NO_PROGRESS) -> None:
    """Raise UserError if a dataset must not be rewritten into `out`.

    The dataset must be complete, must match its index (a new index would hide damage) and must have valid keys. `out`
    must be outside the dataset.
    """
    if not source.info.complete:
        raise UserError(source.store.at("dataset.json"), "complete", "false", "a finished dataset")
    if _within(open_store(out), source.store):
        raise UserError(out, "--out", f"a folder in {source.store}", "a folder outside the dataset")
    check_files(source, progress)
    check_keys(source)


def _within(store: Store, other: Store) -> bool:
    """Whether a store is `other` or a folder inside `other`."""
    if store.folder is not None and other.folder is not None:
        return store.folder.resolve().is_relative_to(other.folder.resolve())
    return store == other or store.address.startswith(f"{other.address}/")


def state_of(sources: list[Dataset], images: ImageMode) -> ImageState:
    """Return where the frames of the result are. Raises UserError if only some sources have frames."""
    states = {source.info.images for source in sources}
    if states == {"planned"} or images == "plan":
        return "planned"
    if "planned" in states:
        raise UserError(sources[0].store, "images", ", ".join(sorted(states)), "all datasets planned, or none of them")
    if images == "none" or states == {"absent"}:
        return "absent"
    if "absent" in states:
        missing = next(source for source in sources if source.info.images == "absent")
        raise UserError(
            missing.store, "images", "absent", "its frames (`perilune-render regenerate`), or --images none"
        )
    return "files"


def without_derived_rows(tables: SceneTables) -> SceneTables:
    """Return a scene without craters, boulders, labels and measurements, which rendering reproduces."""
    return tables | {name: tables[name].slice(0, 0) for name in _DERIVED_TABLES}
