"""Write the dataset card: README.md and card.png, for readers and for dataset repositories.

The page is Markdown with a YAML head in Hugging Face's format (https://huggingface.co/docs/hub/datasets-cards).
Datasets are untrusted, so each text from a dataset is written as a code span, in which unsafe characters are replaced.
"""

import os
import shlex
from collections.abc import Iterable
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from perilune_shared.console.progress import Progress
from perilune_shared.content import terrain_of
from perilune_shared.dataset.info_file import INFO_NAME
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import NOT_STATED, CameraRecord, DatasetInfo, Recipe
from perilune_shared.editing.licence import joined_licence
from perilune_shared.errors import UserError
from perilune_shared.export.added_files import Target, add_files, check_index
from perilune_shared.export.card_head import head_of, table_configs
from perilune_shared.export.card_pictures import TITLES, Gathered, draw, gather
from perilune_shared.export.citation import citation_of
from perilune_shared.export.foreign_text import code_span
from perilune_shared.export.stats import summary

CARD_NAME = "README.md"
_PICTURE_NAME = "card.png"
_MARK_START = "<!-- written by `perilune-manifest card`"
"""Start of the comment that identifies a card; the rest of the comment may differ between versions."""
_MARK = f"{_MARK_START}, which overwrites this file; manual changes are lost -->"
_PURPOSE = {"detect": "Crater detection", "nav": "Navigation"}
_IMAGES = {
    "files": "8- or 16-bit grey PNGs under frames/",
    "packed": "grey PNGs packed in shards/*.parquet",
    "absent": "not included (only the manifest)",
    "planned": "not rendered yet",
}


def write_card(
    dataset: Dataset, out: str | os.PathLike[str] | None, progress: Progress, licence: str | None = None
) -> tuple[str, str]:
    """Write the page and the picture beside it, and add files in the dataset to its index.

    Returns the path or address of the page, then of the picture. The page is `out`, by default README.md in the
    dataset. `licence`, an SPDX expression, replaces the licence of the dataset on the page, and also in dataset.json if
    the page is in the dataset. Raises UserError if a file that is not a card would be overwritten, if the dataset has
    no frames or differs from its index, or if the licence is not an SPDX expression.
    """
    if licence is not None:
        licence = joined_licence([("--licence", licence)])
        dataset = Dataset(dataset.store, dataset.info.model_copy(update={"licence": licence}))
    page = Target.of(dataset, out, CARD_NAME)
    if not page.name.endswith(".md"):
        raise UserError(page.address, "--out", page.name, "a name that ends in .md")
    picture = page.sibling(_PICTURE_NAME if page.name == CARD_NAME else f"{page.name.removesuffix('.md')}.png")
    present = page.content()
    if present is None or _MARK_START.encode() not in present:
        for target in (page, picture):
            if target.content() is not None:
                expected = "another path, or move that file away"
                raise UserError(target.address, "--out", "a file that is not a card", expected)
    info = check_index(dataset, (page, picture), progress)
    gathered = gather(dataset, progress)
    # Create the page before the picture: this checks the keys of the tables and takes much less time.
    text = card_of(dataset, gathered, picture.name).encode()
    # Write the page first: its mark shows a later run that it may overwrite the picture.
    add_files(dataset, {page: text, picture: draw(dataset, gathered)}, info, licence)
    return page.address, picture.address


def card_of(dataset: Dataset, gathered: Gathered, picture_name: str) -> str:
    """Return the text of the page, Markdown with a YAML head."""
    info = dataset.info
    state = "" if info.complete else "\n\n**Not complete**: rendering is in progress or was interrupted."
    parts = [
        head_of(dataset, table_configs(dataset)),
        f"{_MARK}\n\n# {code_span(info.name)}",
        "Rendered images of lunar landing trajectories with exact crater ellipses and camera poses. "
        f"{_purpose(info)}{state}",
        f"![Frames with labels, and histograms]({quote(picture_name)})",
        "*Labels: green if in the selection `visible`, otherwise orange (craters that are hard to see in the frame).*",
        "## Contents\n\n" + _counts(dataset),
        _table(["", "minimum", "5 %", "median", "95 %", "maximum"], _quantiles(gathered)),
        *_real_ground(gathered),
        "## Scenes\n\n" + _scenes(dataset),
        "## Splits\n\n" + _splits(dataset),
        "## Files\n\n" + _files(dataset),
        "## Reproduction\n\n" + "\n\n".join(_remake(key, recipe) for key, recipe in info.recipes.items()),
        "## History\n\n" + (_history(info) or "Not edited since rendering."),
        "## Licence\n\n" + _licence(info.licence),
        "## Citation\n\nThe hash identifies the tables, which contain the hashes of the frames.\n\n"
        f"```bibtex\n{citation_of(dataset)}\n```",
    ]
    return "\n\n".join(parts) + "\n"


def _licence(licence: str) -> str:
    how = "To state one: `perilune-manifest card DATASET --licence CC-BY-4.0`, or another SPDX expression."
    if licence == NOT_STATED:
        return f"Not stated. {how}"
    return code_span(licence) + (f"\n\nThe licence of a part is not stated. {how}" if NOT_STATED in licence else "")


def _history(info: DatasetInfo) -> str:
    return "\n".join(f"- {code_span(line)}" for line in info.history)


def _purpose(info: DatasetInfo) -> str:
    n_scenes, n_trajectories = info.counts.scenes, info.counts.trajectories
    terrains = f"{n_scenes:,} terrains" if n_scenes != 1 else "one terrain"
    trajectories = f"{n_trajectories:,} trajectories" if n_trajectories != 1 else "one trajectory"
    return f"{_PURPOSE[info.kind]}: {trajectories} over {terrains}."


def _counts(dataset: Dataset) -> str:
    frame = summary(dataset).set_index("split").astype(object).T
    rows = [[str(name).replace("_", " "), *map(_cell_text, values)] for name, values in frame.iterrows()]
    total = ", ".join(f"{number:,} {name}" for name, number in dataset.info.counts.model_dump().items())
    return f"{total}.\n\n" + _table(["", *map(str, frame.columns)], rows)


def _quantiles(gathered: Gathered) -> Iterable[list[str]]:
    for name, by_split in gathered.measures.items():
        values = np.concatenate(list(by_split.values()))
        values = values[np.isfinite(values)]
        if len(values):
            yield [TITLES[name], *(f"{value:.4g}" for value in np.quantile(values, [0, 0.05, 0.5, 0.95, 1]))]


def _real_ground(gathered: Gathered) -> Iterable[str]:
    by_split = gathered.measures.get("real_ground_share")
    if by_split is not None:
        values = np.concatenate(list(by_split.values()))
        low, mean, high = (f"{100 * value:.0f}" for value in (np.nanmin(values), np.nanmean(values), np.nanmax(values)))
        yield f"Real ground: on average {mean} % of a frame's ground ({low} to {high} %). The rest is procedural."


def _scenes(dataset: Dataset) -> str:
    scenes = dataset.table("scenes").to_pandas()
    numbers = {
        "latitude, deg": "latitude_deg",
        "longitude, deg": "longitude_deg",
        "Sun's azimuth, deg": "sun_azimuth_deg",
        "Sun's elevation, deg": "sun_elevation_deg",
        "side of the terrain, m": "extent_m",
    }
    rows = [[title, f"{scenes[name].min():.6g} to {scenes[name].max():.6g}"] for title, name in numbers.items()]
    for title, name in {"photometry": "photometry", "source of the terrain": "dem_source"}.items():
        counted = scenes[name].value_counts()
        shown = ", ".join(f"{code_span(value)} ({number})" for value, number in counted.head(8).items())
        rows.append([title, shown + (f" and {len(counted) - 8} more" if len(counted) > 8 else "")])
    citations = dict.fromkeys(filter(None, map(_citation, dataset.info.recipes.values())))
    if citations:
        rows.append(["citation of the terrain", ", ".join(map(code_span, citations))])
    return _table([f"{len(scenes)} scenes", ""], rows)


def _citation(recipe: Recipe) -> str | None:
    """Source and licence of a recipe's elevation model, if its configuration states them."""
    part: Any = recipe.config
    for name in ("terrain", "elevation", "citation"):
        part = part.get(name) if isinstance(part, dict) else None
    return None if part is None else str(part)


def _splits(dataset: Dataset) -> str:
    frames = dataset.table("frames", ["scene_id", "split"]).to_pandas()
    scenes = dataset.table("scenes", ["scene_id", "dem_source", "content_sha256"]).to_pylist()
    terrain = {row["scene_id"]: terrain_of(row["dem_source"], row["content_sha256"]) for row in scenes}
    splits = frames.groupby(frames["scene_id"].map(terrain).to_numpy())["split"].nunique()
    shared = int((splits > 1).sum())
    by = f"Split by {dataset.info.split_by}: no {dataset.info.split_by} is in two splits. "
    if shared:
        return (
            by + f"**{shared} of {len(splits)} terrains are in more than one split**, so test metrics are optimistic."
        )
    return by + "No terrain is in two splits."


def _files(dataset: Dataset) -> str:
    info = dataset.info
    named = info.cameras or {"": info.camera}
    return "\n".join(
        [
            f"- Images: {_IMAGES[info.images]}.",
            *(f"- Camera{f' {name}' if name else ''}: {_camera(camera)}" for name, camera in named.items()),
            "- Tables: manifest/*/*.parquet; the metadata of the files has the unit and meaning of each column.",
            f"- {INFO_NAME}: settings, random seeds and versions; it contains the SHA-256 of index/*.parquet.",
            "- index/*.parquet: path, size and SHA-256 of every other file.",
            f"- Schema version {code_span(info.schema_version)}.",
        ]
    )


def _camera(camera: CameraRecord) -> str:
    lens = "no distortion" if not any(camera.distortion) else f"distortion {', '.join(map(str, camera.distortion))}"
    if camera.model != "pinhole":
        values = "".join(f", {name} {value:g}" for name, value in camera.parameters.items())
        lens += f", lens model {camera.model}{values}"
    return (
        f"{camera.width_px} x {camera.height_px} px, focal length {camera.fx_px:.6g} px, principal point "
        f"({camera.cx_px:.6g}, {camera.cy_px:.6g}) px from the outer corner of the top-left pixel, {lens}."
    )


def _remake(key: str, recipe: Recipe) -> str:
    """Return the text about a recipe, and the commands that reproduce its data."""
    settings = f"json.load(open('{INFO_NAME}'))['recipes']['{key}']['config']"
    unpack = f"python -c \"import json; json.dump({{'dataset': {settings}}}, open('recipe.yaml', 'w'))\""
    if recipe.developed_from is None:
        make = f"perilune-render dataset --preset {shlex.quote(recipe.preset)} --kind {recipe.kind}"
        source = ""
    else:
        make = "perilune-render develop --dataset FIRST"
        origin = recipe.developed_from
        sha256 = code_span(origin.sha256)
        source = f" FIRST is {code_span(origin.name)}, whose {INFO_NAME} has the SHA-256 {sha256}."
    versions = ", ".join(code_span(f"{name} {version}") for name, version in recipe.versions.items())
    return (
        f"Recipe {code_span(key)}: preset {code_span(recipe.preset)}, seed {recipe.seed}, with {versions}.{source} The "
        f"edits in the history were made afterwards. `perilune-render regenerate` renders single frames again.\n\n"
        f"```sh\n{unpack}\n{make} --config recipe.yaml --out again\n```"
    )


def _table(head: list[str], rows: Iterable[list[str]]) -> str:
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell_text(value: object) -> str:
    if value is None or value is pd.NA or (isinstance(value, float) and np.isnan(value)):
        return ""
    return f"{value:,}" if isinstance(value, int | float) else code_span(value)
