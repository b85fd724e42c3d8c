"""What every command that makes a dataset does alike: begin or go on, write a PNG, draw the overview."""

from pathlib import Path

import cv2
import numpy as np

from perilune_render.config import DatasetConfig
from perilune_render.labels import Labels
from perilune_render.picture import draw_labels, enlarge, write_sheet
from perilune_render.plan import Plan
from perilune_shared import files
from perilune_shared.errors import UserError
from perilune_shared.info import CameraInfo, Counts, DatasetInfo, Recipe, recipes_of, write_info
from perilune_shared.manifest import Dataset, open_dataset
from perilune_shared.schema import SCHEMA_VERSION
from perilune_shared.selection import SELECTIONS, selected

LICENCE = "CC-BY-4.0"
_SHEET_FRAMES = 12
_MEANS = ("threads", "cache_gib")


def info_of(config: DatasetConfig, plan: Plan, recipe: Recipe) -> DatasetInfo:
    """The dataset.json of a dataset that is begun."""
    return DatasetInfo(
        name=f"perilune-{recipe.preset}-{recipe.kind}",
        kind=recipe.kind,
        schema_version=SCHEMA_VERSION,
        complete=False,
        images="files",
        split_by=config.kind(recipe.kind).split_by,
        camera=CameraInfo.of(plan.camera),
        exr_camera=CameraInfo.of(plan.exr_camera) if config.render.exr else None,
        recipes=recipes_of(recipe),
        counts=Counts(),
        licence=LICENCE,
    )


def begin_or_go_on(out: Path, info: DatasetInfo) -> DatasetInfo:
    """Write the dataset.json of a new dataset, or read that of one that was begun with the same settings.

    Raises UserError where `out` holds something else.
    """
    if not (out / "dataset.json").exists():
        if out.exists() and any(out.iterdir()):
            raise UserError(
                out,
                "--out",
                "a folder with other content",
                "an empty or new folder, or a dataset to go on with",
            )
        write_info(out, info)
        return info
    existing = open_dataset(out).info
    if len(existing.recipes) != 1 or existing.history != info.history:
        raise UserError(out, "--out", f"a dataset put together otherwise: {existing.name}", "another folder")
    for name in ("kind", "config", "versions", "developed_from"):
        theirs, ours = (_compared(each.recipe(), name) for each in (existing, info))
        if theirs != ours:
            raise UserError(
                out / "dataset.json",
                name,
                first_difference(theirs, ours),
                "the settings that this dataset was begun with, or another --out",
            )
    return existing


def _compared(recipe: Recipe, name: str) -> object:
    """One field of a recipe, without the settings that change how fast, not what."""
    value = getattr(recipe, name)
    if name != "config":
        return value
    return {**value, "render": {k: v for k, v in value.get("render", {}).items() if k not in _MEANS}}


def first_difference(theirs: object, ours: object, path: str = "") -> str:
    """The first setting, by name, in which two trees of plain data differ, with both values."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in sorted({*theirs, *ours}):
            if theirs.get(key) != ours.get(key):
                return first_difference(theirs.get(key), ours.get(key), f"{path}.{key}".lstrip("."))
    return f"{path} {theirs!r} there, {ours!r} asked for".strip()


def write_png(root: Path, frame_id: str, image: np.ndarray, bits: int) -> dict[str, str | int]:
    """Write a frame's PNG; its columns png_* of the manifest.

    Above 8 bits a grey value stands in the upper bits of a 16-bit number, with zeros below.
    """
    path = f"frames/{frame_id}.png"
    stored = image if bits == 8 else image << (16 - bits)
    files.write_bytes(files.inside(root, path), cv2.imencode(".png", stored)[1].tobytes())
    return file_columns(root, "png", path)


def file_columns(root: Path, kind: str, path: str) -> dict[str, str | int]:
    """The columns png_* or exr_* of a file that was written."""
    whole = root / path
    return {
        f"{kind}_path": path,
        f"{kind}_bytes": whole.stat().st_size,
        f"{kind}_sha256": files.sha256_of(whole),
    }


def write_overview(dataset: Dataset) -> None:
    """overview.png: frames from the whole dataset, each beside itself with its labels, green where they are visible."""
    frames = dataset.table("frames", ["frame_id", "scene_id", "png_path"]).to_pandas()
    chosen = frames.iloc[np.unique(np.linspace(0, len(frames) - 1, _SHEET_FRAMES).astype(int))]
    labels = dataset.table("labels").to_pandas()
    craters = dataset.table("craters", ["scene_id", "crater_id", "depth_m", "diameter_m"]).to_pandas()
    pictures = []
    for frame in chosen.itertuples():
        image = cv2.imread(str(dataset.file(frame.png_path)), cv2.IMREAD_GRAYSCALE)
        own = labels[labels["frame_id"] == frame.frame_id]
        own = own.merge(craters[craters["scene_id"] == frame.scene_id], on="crater_id")
        drawn = draw_labels(image, Labels.from_table(own), selected(own, SELECTIONS["visible"]))
        pictures += [enlarge(image, 2), drawn]
    write_sheet(dataset.root / "overview.png", pictures, 6)
