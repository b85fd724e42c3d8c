"""Begin or resume a dataset, and prevent other runs from writing it at the same time."""

import contextlib
from collections.abc import Iterator

from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset.finish import remove_work
from perilune_render.dataset.work import FOLDER
from perilune_render.flight.plan import Plan
from perilune_render.flight.rig import MountedCamera
from perilune_render.provenance.versions import all_versions
from perilune_shared.dataset.info_file import INFO_NAME, info_bytes
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.metadata import NOT_STATED, CameraRecord, Counts, DatasetInfo, Recipe, recipes_of
from perilune_shared.dataset.schema import SCHEMA_VERSION
from perilune_shared.errors import UserError
from perilune_shared.storage.claims import claimed
from perilune_shared.storage.locks import LOCK_NAME, TEMPORARY_FILE, locked
from perilune_shared.storage.store import Store


def new_info(config: DatasetConfig, plan: Plan, recipe: Recipe) -> DatasetInfo:
    """The dataset.json of a new dataset."""
    settings = config.kind(recipe.kind)
    split_by = settings.split_by
    if split_by == "scene" and config.terrain.dem is not None and settings.n_scenes > 1:
        split_by = "trajectory"  # all scenes show the same elevation model
    camera, exr_camera = camera_records(plan.first)

    def named(which: int) -> dict[str, CameraRecord]:
        return {str(name): camera_records(each)[which] for name, each in plan.rig.items()}

    return DatasetInfo(
        name=f"perilune-{config.name}-{recipe.kind}",
        kind=recipe.kind,
        schema_version=SCHEMA_VERSION,
        complete=False,
        images="files",
        split_by=split_by,
        camera=camera,
        exr_camera=exr_camera if config.render.exr else None,
        cameras=named(0) if len(plan.rig) > 1 else None,
        exr_cameras=named(1) if len(plan.rig) > 1 and config.render.exr else None,
        recipes=recipes_of(recipe),
        counts=Counts(),
        licence=NOT_STATED,
    )


def camera_records(mounted: MountedCamera) -> tuple[CameraRecord, CameraRecord]:
    """The records of a camera in dataset.json: one for its frames and one for its EXRs, both with the mounting."""
    x, y, z = mounted.position_in_body_m.tolist()
    mounting = mounted.rotation_camera_from_body, (x, y, z)
    return CameraRecord.of(mounted.camera, *mounting), CameraRecord.of(mounted.exr_camera, *mounting)


@contextlib.contextmanager
def writing(store: Store) -> Iterator[None]:
    """Prevent other runs from writing a dataset until the block ends.

    A folder gets a lock file, an object store a claim. A finished dataset is not locked, since it may be on a read-only
    disk. Raises UserError if another run is writing.
    """
    if is_complete(store):
        yield
    elif store.folder is not None:
        with locked(store.folder):
            yield
    else:
        with claimed(store, f"{FOLDER}/claims"):
            yield


def is_complete(store: Store) -> bool:
    """Whether an address holds a finished dataset. Raises UserError if its dataset.json is damaged."""
    return store.exists(INFO_NAME) and open_dataset(store).info.complete


def is_begun(store: Store) -> bool:
    """Whether an address holds a dataset, finished or not. Raises UserError if it holds other files."""
    if store.folder is not None:
        others = [p.name for p in (store.folder.iterdir() if store.folder.exists() else ()) if not _is_work(p.name)]
    else:
        begun = store.exists(INFO_NAME)
        others = [] if begun else [item.path for item in store.list() if not _is_work(item.path.partition("/")[0])]
    # Check this last: another process may be starting the same dataset, and it writes dataset.json first.
    begun = store.exists(INFO_NAME)
    if others and not begun:
        expected = "an empty or new folder or address, or a dataset to resume"
        raise UserError(store, "--out", "a folder with other content", expected)
    return begun


def _is_work(name: str) -> bool:
    """Whether a file of this name may exist before dataset.json."""
    return name == FOLDER or name.startswith(LOCK_NAME) or TEMPORARY_FILE.fullmatch(name) is not None


def begin_or_resume(store: Store, info: DatasetInfo) -> DatasetInfo:
    """Write the dataset.json of a new dataset, or read the dataset.json of an existing one with the same settings.

    Raises UserError if the address holds other files, or a dataset with other settings or code.
    """
    if not is_begun(store):
        # The file exists if another process has started the same dataset in the meantime.
        with contextlib.suppress(FileExistsError):
            store.write(INFO_NAME, info_bytes(info, store.at(INFO_NAME)))
    existing = open_dataset(store).info
    if len(existing.recipes) != 1 or existing.history != info.history:
        raise UserError(store, "--out", f"a dataset with other recipes or history: {existing.name}", "another folder")
    if existing.images != info.images:
        raise UserError(store, "--out", f"a dataset whose frames are {existing.images}", "another folder")
    for name in ("kind", "config", "versions", "developed_from"):
        recorded, requested = (_compared(each.recipe(), name) for each in (existing, info))
        if recorded != requested:
            raise UserError(
                store.at(INFO_NAME),
                name,
                first_difference(recorded, requested),
                "the settings that this dataset was started with, or another --out",
            )
    return existing


def open_finished(store: Store) -> Dataset:
    """Open a complete dataset; remove the files that a killed run left below work/."""
    remove_work(store)
    return open_dataset(store)


def check_code(recipe: Recipe, *, with_dem: bool) -> None:
    """Raise UserError if this process has other code or libraries than a recipe records."""
    current = all_versions(
        with_dem=with_dem,
        engine=recipe.config.get("render", {}).get("engine", "cycles"),
        device=recipe.config.get("render", {}).get("device", "cpu"),
        outputs="hazard" in recipe.config or "flash_lidar" in recipe.config,
    )
    recorded, current = (_without_releases(versions) for versions in (recipe.versions, current))
    if recorded != current:
        expected = "the code that the rendering began with: render with one version from start to end"
        raise UserError("perilune_render", "versions", first_difference(recorded, current), expected)


def _compared(recipe: Recipe, name: str) -> object:
    """A field of a recipe, without release numbers if it is `versions`."""
    return _without_releases(recipe.versions) if name == "versions" else getattr(recipe, name)


def _without_releases(versions: dict[str, str]) -> dict[str, str]:
    """Versions without perilune's release numbers, since hashes identify its code."""
    return {name: version for name, version in versions.items() if not name.startswith("perilune")}


def first_difference(recorded: object, requested: object, path: str = "") -> str:
    """Text with the name and both values of the first setting that differs between two nested dicts."""
    if isinstance(recorded, dict) and isinstance(requested, dict):
        for key in sorted({*recorded, *requested}):
            if recorded.get(key) != requested.get(key):
                return first_difference(recorded.get(key), requested.get(key), f"{path}.{key}".lstrip("."))
    return f"{path} {requested!r} in place of the recorded {recorded!r}".strip()
