"""Write the dataset card, for readers and for dataset repositories: README.md and card.png.

The page is Markdown with a YAML head in Hugging Face's format (https://huggingface.co/docs/hub/datasets-cards).
Datasets are untrusted: each text from a dataset is put in a code span, reduced to letters, digits and harmless marks.
"""

import shlex
import string
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pandas as pd

from perilune_shared.content import terrain_of
from perilune_shared.dataset.info_file import INFO_NAME
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo, Recipe
from perilune_shared.dataset.stats import summary
from perilune_shared.errors import UserError, one_line, shortened
from perilune_shared.export.added_files import add_files, check_sums
from perilune_shared.export.card_head import head_of, table_configs
from perilune_shared.export.card_pictures import TITLES, Gathered, draw, gather
from perilune_shared.export.croissant import citation_of
from perilune_shared.progress import Progress

CARD_NAME = "README.md"
_PICTURE_NAME = "card.png"
_MARK = "<!-- written by `perilune-manifest card`, which writes it anew; changes by hand are lost -->"
_HARMLESS = frozenset(string.ascii_letters + string.digits + " ._+,:()/%=?-")
_PURPOSE = {"detect": "Crater detection", "nav": "Navigation"}
_IMAGES = {
    "files": "8- or 16-bit grey PNGs under frames/",
    "packed": "grey PNGs packed in images/*.parquet",
    "absent": "not here: the manifest alone",
    "planned": "not rendered yet",
}


def write_card(dataset: Dataset, out: Path | None, progress: Progress) -> tuple[Path, Path]:
    """Write the page and the picture beside it, and update the dataset's checksums; return the two paths.

    `out` is by default README.md in the dataset. Raises UserError if a file that is not a card would be overwritten,
    the dataset has no frames or its checksums are wrong.
    """
    out = out or dataset.root / CARD_NAME
    if out.suffix != ".md":
        raise UserError(out, "--out", out.name, "a name that ends in .md")
    picture = out.with_name(_PICTURE_NAME) if out.name == CARD_NAME else out.with_suffix(".png")
    ours = out.is_file() and _MARK in out.read_text(encoding="utf-8", errors="replace")
    for path in (out, picture):
        if path.exists() and not ours:
            raise UserError(path, "--out", "a file that is not a card", "another path, or move that file away")
    known = check_sums(dataset, (out, picture), progress)
    gathered = gather(dataset, progress)
    # Build the page first: it checks the keys and is much faster than the picture.
    page = card_of(dataset, gathered, picture.name).encode()
    add_files(dataset, {picture: draw(dataset, gathered), out: page}, known)
    return out, picture


def code(value: object) -> str:
    """Format untrusted text as a code span that is safe in Markdown, in its tables and in HTML."""
    text = "".join(c if c in _HARMLESS else "?" for c in shortened(one_line(value), 200))
    return f"`{text.strip() or 'none'}`"


def card_of(dataset: Dataset, gathered: Gathered, picture_name: str) -> str:
    """Return the page as Markdown."""
    info = dataset.info
    state = "" if info.complete else "\n\n**Not complete**: the renderer is still at work, or was stopped."
    parts = [
        head_of(dataset, table_configs(dataset)),
        f"{_MARK}\n\n# {code(info.name)}",
        f"Rendered lunar descents with exact crater ellipses and camera poses. {_purpose(info)}{state}",
        f"![Frames with labels, and histograms]({quote(picture_name)})",
        "*Labels: green where the selection `visible` takes them, orange for craters that a frame hardly shows.*",
        "## What it holds\n\n" + _counts(dataset),
        _table(["", "lowest", "5 %", "median", "95 %", "highest"], _quantiles(gathered)),
        *_real_ground(gathered),
        "## Scenes\n\n" + _scenes(dataset),
        "## Splits\n\n" + _splits(dataset),
        "## Files\n\n" + _files(dataset),
        "## Making it again\n\n" + "\n\n".join(_remake(key, recipe) for key, recipe in info.recipes.items()),
        "## History\n\n" + ("\n".join(f"- {code(line)}" for line in info.history) or "As rendered."),
        f"## Licence\n\n{code(info.licence)}",
        f"## Citation\n\nThe hash names this dataset and no other.\n\n```bibtex\n{citation_of(dataset)}\n```",
    ]
    return "\n\n".join(parts) + "\n"


def _purpose(info: DatasetInfo) -> str:
    """Describe the dataset's purpose and its numbers of trajectories and terrains."""
    n_scenes, n_trajectories = info.counts.scenes, info.counts.trajectories
    terrains = f"{n_scenes:,} terrains" if n_scenes != 1 else "one terrain"
    trajectories = f"{n_trajectories:,} trajectories" if n_trajectories != 1 else "one trajectory"
    return f"{_PURPOSE[info.kind]}: {trajectories} over {terrains}."


def _counts(dataset: Dataset) -> str:
    frame = summary(dataset).set_index("split").astype(object).T
    rows = [[str(name).replace("_", " "), *map(_shown, values)] for name, values in frame.iterrows()]
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
        yield f"Real ground: {mean} % of a frame's ground in the mean, from {low} to {high} %. The rest is procedural."


def _scenes(dataset: Dataset) -> str:
    scenes = dataset.table("scenes").to_pandas()
    numbers = {
        "latitude, deg": "latitude_deg",
        "longitude, deg": "longitude_deg",
        "Sun's azimuth, deg": "sun_azimuth_deg",
        "Sun's elevation, deg": "sun_elevation_deg",
        "side, m": "extent_m",
    }
    rows = [[title, f"{scenes[name].min():.6g} to {scenes[name].max():.6g}"] for title, name in numbers.items()]
    for title, name in {"photometry": "photometry", "ground from": "dem_source"}.items():
        counted = scenes[name].value_counts()
        shown = ", ".join(f"{code(value)} ({number})" for value, number in counted.head(8).items())
        rows.append([title, shown + (f" and {len(counted) - 8} more" if len(counted) > 8 else "")])
    return _table([f"{len(scenes)} scenes", ""], rows)


def _splits(dataset: Dataset) -> str:
    frames = dataset.table("frames", ["scene_id", "split"]).to_pandas()
    scenes = dataset.table("scenes", ["scene_id", "dem_source", "content_sha256"]).to_pylist()
    terrain = {row["scene_id"]: terrain_of(row["dem_source"], row["content_sha256"]) for row in scenes}
    splits = frames.groupby(frames["scene_id"].map(terrain).to_numpy())["split"].nunique()
    shared = int((splits > 1).sum())
    by = f"Split by {dataset.info.split_by}: that is what no two splits share. "
    if shared:
        return by + f"**{shared} of {len(splits)} terrains are in more than one split**, so that test figures flatter."
    return by + "No terrain is in two splits."


def _files(dataset: Dataset) -> str:
    info, camera = dataset.info, dataset.info.camera
    lens = "no distortion" if not any(camera.distortion) else f"distortion {', '.join(map(str, camera.distortion))}"
    return "\n".join(
        [
            f"- Images: {_IMAGES[info.images]}.",
            f"- Camera: {camera.width_px} x {camera.height_px} px, focal length {camera.fx_px:.6g} px, principal point "
            f"({camera.cx_px:.6g}, {camera.cy_px:.6g}) px from the outer corner of the top-left pixel, {lens}.",
            "- Tables: manifest/*/*.parquet; unit and meaning of each column stand in the files.",
            f"- {INFO_NAME}: everything that it was made by. SHA256SUMS: `sha256sum -c SHA256SUMS`.",
            f"- Schema version {code(info.schema_version)}.",
        ]
    )


def _remake(key: str, recipe: Recipe) -> str:
    """Return the commands that reproduce a recipe's data; names are quoted for the shell."""
    settings = f"json.load(open('{INFO_NAME}'))['recipes']['{key}']['config']"
    unpack = f"python -c \"import json; json.dump({{'dataset': {settings}}}, open('recipe.yaml', 'w'))\""
    if recipe.developed_from is None:
        make = f"perilune-render dataset --preset {shlex.quote(recipe.preset)} --kind {recipe.kind}"
        source = ""
    else:
        make = "perilune-render develop --dataset FIRST"
        origin = recipe.developed_from
        source = f" FIRST is {code(origin.name)}, whose {INFO_NAME} has the SHA-256 {code(origin.sha256)}."
    versions = ", ".join(code(f"{name} {version}") for name, version in recipe.versions.items())
    return (
        f"Recipe {code(key)}: preset {code(recipe.preset)}, seed {recipe.seed}, with {versions}.{source} What the "
        f"history tells was done after. Single frames come again by `perilune-render regenerate`.\n\n"
        f"```sh\n{unpack}\n{make} --config recipe.yaml --out again\n```"
    )


def _table(head: list[str], rows: Iterable[list[str]]) -> str:
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _shown(value: object) -> str:
    if value is None or value is pd.NA or (isinstance(value, float) and np.isnan(value)):
        return ""
    return f"{value:,}" if isinstance(value, int | float) else code(value)
