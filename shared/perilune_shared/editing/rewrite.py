"""One dataset rewritten as another: the way of all tools that change or choose rows."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import pyarrow.compute as pc
from rich.progress import Progress

from perilune_shared.dataset.keys import check_keys
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.schema import ImageState
from perilune_shared.dataset.writer import SceneTables, written
from perilune_shared.errors import UserError
from perilune_shared.storage import checksums

ImageMode = Literal["copy", "link", "none", "plan"]
"""How frames are written: copies; hard links where the disk allows them (then a frame edited in one dataset changes in
the other too); or left out. With `plan` craters, boulders and labels are left out too: they follow from scenes and
poses."""
_FOLLOWING = ("craters", "boulders", "labels")


def rewrite(
    source: Dataset,
    out: Path,
    info: DatasetInfo,
    change: Callable[[SceneTables], SceneTables],
    images: ImageMode,
    progress: Progress | None = None,
    scene_ids: Sequence[str] | None = None,
) -> None:
    """Write every scene of `source`, or those named, as `change` gives it.

    Scenes and labels without frames are left out. The caller has checked the source (`check_source`).
    """
    info = info.model_copy(update={"images": state_of([source], images)})
    scene_ids = source.scene_ids() if scene_ids is None else scene_ids
    task = progress.add_task("writing", total=len(scene_ids), unit="scenes", note="") if progress else None
    with written(out, info, progress=progress) as writer:
        for scene_id in scene_ids:
            tables = change(source.scene(scene_id))
            frames = tables["frames"]
            if len(frames):
                own = pc.is_in(tables["labels"]["frame_id"], frames["frame_id"].combine_chunks())
                tables = {**tables, "labels": tables["labels"].filter(own)}
                writer.add_scene(bare(tables) if info.images == "planned" else tables)
                if info.images == "files":
                    names = {name: name for name in frames["frame_id"].to_pylist()}
                    writer.add_images(source, frames, names, link=images == "link")
            if progress is not None and task is not None:
                progress.advance(task)


def check_source(source: Dataset, out: Path, progress: Progress | None = None) -> None:
    """Raises UserError on a dataset whose rows are not to be handed on into `out`.

    That is one that is still being rendered, whose files are not those of its SHA256SUMS (new sums would hide it for
    good), whose keys are broken, or in whose folder `out` lies.
    """
    if not source.info.complete:
        raise UserError(source.root / "dataset.json", "complete", "false", "a finished dataset")
    if out.resolve().is_relative_to(source.root.resolve()):
        raise UserError(out, "--out", f"a folder in {source.root}", "one outside the dataset")
    for name, found, wanted in checksums.faults_of(source.root, progress):
        raise UserError(source.root / name, "SHA-256", found, f"{wanted}; see `perilune-manifest validate`")
    check_keys(source)


def state_of(sources: list[Dataset], images: ImageMode) -> ImageState:
    """Where the frames of what is written will be. Raises UserError where only some of the sources have theirs."""
    states = {source.info.images for source in sources}
    if states == {"planned"} or images == "plan":
        return "planned"
    if "planned" in states:
        raise UserError(sources[0].root, "images", ", ".join(sorted(states)), "datasets that are all planned, or none")
    if images == "none" or states == {"absent"}:
        return "absent"
    if "absent" in states:
        missing = next(source for source in sources if source.info.images == "absent")
        raise UserError(missing.root, "images", "absent", "its frames (`perilune-render regenerate`), or --images none")
    return "files"


def bare(tables: SceneTables) -> SceneTables:
    """A scene without the rows that follow from its seed and poses."""
    return tables | {name: tables[name].slice(0, 0) for name in _FOLLOWING}
