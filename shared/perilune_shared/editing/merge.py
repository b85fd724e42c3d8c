"""Merge several datasets into one."""

from collections.abc import Container, Sequence

import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.dataset.manifest import Dataset, check_single
from perilune_shared.dataset.metadata import CameraRecord, DatasetInfo
from perilune_shared.dataset.names import SCENE_FILE_KINDS, ImageMode, frame_id_of
from perilune_shared.dataset.schema import OPTIONAL_TABLES
from perilune_shared.editing.licence import joined_licence
from perilune_shared.editing.rewrite import check_source, state_of, without_derived_rows
from perilune_shared.editing.writer import SceneTables, check_scene, new_dataset, of_trajectories, with_column
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address

_TERRAIN_TABLES = ("scenes", "craters", "boulders")
_FREE_IN_TRAJECTORIES = ("scene_id", "trajectory_id", "n_frames", "split")
"""Columns that may differ between two copies of the same trajectory."""
_FIXED_IN_FRAMES = ("position_m", "rotation_wxyz", "time_s", "png_sha256")
"""Columns that must be equal in two copies of the same frame."""


def merge(
    sources: Sequence[Dataset],
    out: Address,
    name: str = "merged",
    images: ImageMode = "copy",
    progress: Progress = NO_PROGRESS,
) -> None:
    """Write the frames of all sources, each once, as one dataset.

    Equal scenes (recipe, seed, Sun, craters) become one scene; different scenes with equal names are renamed.
    Trajectories are merged and renamed in the same way. A frame that occurs in several sources is taken from the first
    of them, with its split and labels. The hazard map of a scene is also taken from the first source. Counts, splits
    and `split_by` are recomputed from the rows. Raises UserError if kinds, cameras or EXR cameras differ, if a licence
    is not an SPDX expression, or if two copies of a frame were rendered differently.
    """
    if len(sources) < 2:
        raise UserError("merge", "datasets", len(sources), "at least two")
    for source in {_location(source): source for source in sources}.values():
        check_single(source)
        check_source(source, out, progress)
    info = _joined_info(sources, name, state_of(list(sources), images))
    groups = _same_scenes(sources, planned=info.images == "planned")
    task = progress.add_task("merging", total=len(groups), unit="scenes")
    with new_dataset(out, info) as writer:
        for scene_id, members in groups.items():
            tables, used_frames = _join(scene_id, [(sources[i], source_id) for i, source_id in members])
            writer.add_scene(without_derived_rows(tables) if info.images == "planned" else tables)
            if info.images == "files":
                (i, source_id), *_ = members
                link = images == "link"
                writer.add_scene_files(sources[i], sources[i].table("scenes", scene_id=source_id), scene_id, link=link)
            for source, frames, names in used_frames:
                if info.images == "files" and len(frames):
                    writer.add_images(source, frames, names, link=images == "link")
            progress.advance(task)


def _joined_info(sources: Sequence[Dataset], name: str, images: str) -> DatasetInfo:
    first = sources[0].info
    for source in sources:
        for field in ("kind", "camera"):
            if getattr(source.info, field) != getattr(first, field):
                raise UserError(source.store, field, f"a different {field}", f"the {field} of {sources[0].store}")
    info = first.model_copy(
        update={
            "name": name,
            "images": images,
            "exr_camera": _exr_camera(sources),
            "recipes": {key: recipe for source in sources for key, recipe in source.info.recipes.items()},
            "licence": joined_licence((source.store, source.info.licence) for source in sources),
            "history": tuple(dict.fromkeys(line for source in sources for line in source.info.history)),
        }
    )
    return info.changed("merge of " + ", ".join(source.info.name for source in sources))


def _location(source: Dataset) -> object:
    return source.store.folder.resolve() if source.store.folder is not None else source.store


def _exr_camera(sources: Sequence[Dataset]) -> CameraRecord | None:
    """Return the camera of all EXRs. Raises UserError if two sources have EXRs of different cameras."""
    with_exrs = [source for source in sources if _has_exrs(source)]
    for source in with_exrs:
        if source.info.exr_camera != with_exrs[0].info.exr_camera:
            expected = f"the exr_camera of {with_exrs[0].store}; `perilune-manifest pack` leaves EXRs out"
            raise UserError(source.store, "exr_camera", "a different camera", expected)
    return with_exrs[0].info.exr_camera if with_exrs else None


def _has_exrs(source: Dataset) -> bool:
    paths = source.table("frames", ["exr_path"])["exr_path"]
    return paths.null_count < len(paths)


def _same_scenes(sources: Sequence[Dataset], *, planned: bool) -> dict[str, list[tuple[int, str]]]:
    """Group equal scenes of the sources.

    For each scene_id of the result, lists the equal scenes as (index of the source, scene_id in the source). Crater ids
    are not compared for plans, which have no labels.
    """
    groups: dict[str, list[tuple[int, str]]] = {}
    known: dict[tuple, str] = {}
    for i, source in enumerate(sources):
        for row in sorted(source.table("scenes").to_pylist(), key=lambda row: row["scene_id"]):
            source_id = row.pop("scene_id")
            # Ignore files, since a packed copy of a scene has none.
            row = {name: value for name, value in row.items() if not name.startswith(SCENE_FILE_KINDS)}
            # Labels refer to craters by id, so equal scenes must have equal crater ids.
            craters = (
                [] if planned else source.table("craters", ["crater_id"], scene_id=source_id)["crater_id"].to_pylist()
            )
            key = (*row.values(), tuple(craters))
            if key not in known or any(number == i for number, _ in groups[known[key]]):
                known[key] = free_name(source_id, groups)
                groups[known[key]] = []
            groups[known[key]].append((i, source_id))
    return groups


def free_name(name: str, taken: Container[str]) -> str:
    """Return a name that is not taken: `name`, or `name` with -2, -3, ... appended."""
    tried, number = name, 1
    while tried in taken:
        number += 1
        tried = f"{name[:56]}-{number}"
    return tried


def _join(
    scene_id: str, members: Sequence[tuple[Dataset, str]]
) -> tuple[SceneTables, list[tuple[Dataset, pa.Table, dict[str, str]]]]:
    """Return the tables of a merged scene; for each source, the frames taken and the new frame_ids."""
    joined: dict[str, list[pa.Table]] = {name: [] for name in ("trajectories", "frames", "labels", *OPTIONAL_TABLES)}
    used_frames: list[tuple[Dataset, pa.Table, dict[str, str]]] = []
    known_trajectories: list[tuple[dict, str]] = []
    taken: dict[str, dict] = {}
    first: SceneTables = {}
    for source, source_id in members:
        tables = source.scene(source_id)
        check_scene(source.store, tables)
        if not first:
            first = {
                name: with_column(tables[name], "scene_id", [scene_id] * len(tables[name])) for name in _TERRAIN_TABLES
            }
        new_ids, rows = _trajectories(tables["trajectories"], known_trajectories)
        rows = _with_new_ids(rows, scene_id, new_ids)
        joined["trajectories"].append(rows)
        for name in OPTIONAL_TABLES:
            joined[name].append(of_trajectories(_with_new_ids(tables[name], scene_id, new_ids), rows))
        frames = tables["frames"]
        old = frames.select(["frame_id", "trajectory_id", "frame_index", *_FIXED_IN_FRAMES]).to_pylist()
        names = {
            row["frame_id"]: frame_id_of(scene_id, new_ids[row["trajectory_id"]], row["frame_index"]) for row in old
        }
        is_new = []
        for row in old:
            earlier = taken.get(names[row["frame_id"]])
            is_new.append(earlier is None)
            if earlier is None:
                taken[names[row["frame_id"]]] = row
            else:
                _check_same(source, row, earlier)
        chosen = frames.filter(pa.array(is_new, pa.bool_()))
        labels = tables["labels"].filter(pc.is_in(tables["labels"]["frame_id"], chosen["frame_id"].combine_chunks()))
        joined["frames"].append(_renamed(chosen, scene_id, new_ids, names))
        labelled = [names[frame_id] for frame_id in labels["frame_id"].to_pylist()]
        joined["labels"].append(with_column(labels, "frame_id", labelled))
        used_frames.append((source, chosen, names))
    return first | {name: pa.concat_tables(pieces) for name, pieces in joined.items()}, used_frames


def _trajectories(trajectories: pa.Table, known: list[tuple[dict, str]]) -> tuple[dict[str, str], pa.Table]:
    """Return the new id of each trajectory, and the rows of trajectories that are not yet in `known`.

    `known` has content and new id of the trajectories of earlier sources; new trajectories are added to it.
    """
    names: dict[str, str] = {}
    new = []
    for row in trajectories.to_pylist():
        content = {name: value for name, value in row.items() if name not in _FREE_IN_TRAJECTORIES}
        matching_ids = [name for other, name in known if other == content and name not in names.values()]
        if not matching_ids:
            matching_ids = [free_name(row["trajectory_id"], {name for _, name in known})]
            known.append((content, matching_ids[0]))
            new.append(True)
        else:
            new.append(False)
        names[row["trajectory_id"]] = matching_ids[0]
    return names, trajectories.filter(pa.array(new, pa.bool_()))


def _check_same(source: Dataset, row: dict, earlier: dict) -> None:
    for name in _FIXED_IN_FRAMES:
        if None not in (row[name], earlier[name]) and row[name] != earlier[name]:
            raise UserError(
                source.store, row["frame_id"], f"a different {name}", "the same value as in the other dataset"
            )


def _renamed(frames: pa.Table, scene_id: str, new_ids: dict[str, str], names: dict[str, str]) -> pa.Table:
    ids = [names[frame_id] for frame_id in frames["frame_id"].to_pylist()]
    return with_column(_with_new_ids(frames, scene_id, new_ids), "frame_id", ids)


def _with_new_ids(rows: pa.Table, scene_id: str, new_ids: dict[str, str]) -> pa.Table:
    """Return rows with the new scene_id and trajectory_ids."""
    rows = with_column(rows, "scene_id", [scene_id] * len(rows))
    return with_column(rows, "trajectory_id", [new_ids[name] for name in rows["trajectory_id"].to_pylist()])
