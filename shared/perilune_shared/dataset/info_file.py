"""Read and write dataset.json, which may be untrusted."""

import json
import math
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from perilune_shared.config_errors import expected_of, formatted
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.schema import SCHEMA_VERSION, TABLES
from perilune_shared.errors import UserError, shortened
from perilune_shared.storage import files

INFO_NAME = "dataset.json"
_LARGEST_INFO_BYTES = 10_000_000


def read_object(path: Path) -> dict[str, Any]:
    """Read the JSON object in a file. Raises UserError if the file is missing, too large or not a JSON object."""
    if not path.exists() and not path.is_symlink():
        raise UserError(path.parent, path.name, "no such file", "the folder of a dataset (see `make dataset`)")
    n_bytes = files.check_plain_file(path)
    if n_bytes > _LARGEST_INFO_BYTES:
        raise UserError(path, "size", f"{n_bytes} bytes", f"at most {_LARGEST_INFO_BYTES}")
    try:
        content = json.loads(
            path.read_bytes(), object_pairs_hook=_with_unique_names, parse_constant=_finite, parse_float=_finite
        )
    except (ValueError, RecursionError) as error:
        raise UserError(path, "content", error, "JSON") from None
    if not isinstance(content, dict):
        raise UserError(path, "content", type(content).__name__, "a JSON object")
    return content


def _with_unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build a dict from members. Raises ValueError on a duplicate name, since readers differ in which one they use."""
    members: dict[str, Any] = {}
    for name, value in pairs:
        if name in members:
            raise ValueError(f"duplicate name {shortened(name, 40)!r}")
        members[name] = value
    return members


def _finite(number: str) -> float:
    if not math.isfinite(float(number)):
        raise ValueError(f"number {shortened(number, 40)} out of range")
    return float(number)


def read_info(root: Path) -> DatasetInfo:
    """Read a folder's dataset.json. Raises UserError if it is missing, damaged or of another schema version."""
    path = root / INFO_NAME
    content = read_object(path)
    for folder in (root / "manifest", root / "shards", *(root / "manifest" / table for table in TABLES)):
        if folder.is_symlink():
            raise UserError(folder, "folder", "a link", "a folder")
    if content.get("images") == "packed" and (root / "images").exists():
        expected = "frames in shards/; unpack the dataset with the version of perilune that packed it"
        raise UserError(path, "images", "frames in images/*.parquet", expected)
    version = content.get("schema_version")
    if version != SCHEMA_VERSION:
        raise UserError(path, "schema_version", version, f"{SCHEMA_VERSION}; see `perilune-manifest migrate`")
    return checked_info(content, path)


def checked_info(content: dict[str, Any], path: Path) -> DatasetInfo:
    """Validate plain data as a DatasetInfo. Raises UserError about the first wrong field."""
    try:
        info = DatasetInfo.model_validate_json(json.dumps(content))
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in fault["loc"])
        raise UserError(path, field or "content", formatted(fault["input"]), expected_of(fault)) from None
    except RecursionError as error:
        raise UserError(path, "content", error, "JSON with fewer levels") from None
    _check_texts(info, path)
    for key, recipe in info.recipes.items():
        if recipe.key != key:
            raise UserError(path, "recipes", f"the key {key}", f"{recipe.key}, the hash of the recipe")
    return info


def _check_texts(info: DatasetInfo, path: Path) -> None:
    """Check the texts of recipes, since settings are untrusted and are shown on pages and terminals."""
    for recipe in info.recipes.values():
        unsafe = _unsafe_text([recipe.config, recipe.developed_from.camera_config if recipe.developed_from else None])
        if unsafe is not None:
            raise UserError(path, "recipes", repr(unsafe), "plain text, without <, >, &, $, ` and control characters")


def _unsafe_text(tree: object) -> str | None:
    """Return the first text or member name in plain data that contains unsafe characters; None if there is none."""
    if isinstance(tree, str):
        return None if tree.isprintable() and not set(tree) & set("<>&`$") else tree
    if isinstance(tree, dict):
        tree = [*tree, *tree.values()]
    if isinstance(tree, list):
        return next((unsafe for unsafe in map(_unsafe_text, tree) if unsafe is not None), None)
    return None


def write_info(root: Path, info: DatasetInfo) -> None:
    """Write dataset.json atomically. Raises UserError if texts of its recipes contain unsafe characters."""
    _check_texts(info, root / INFO_NAME)
    files.write_text(root / INFO_NAME, info.model_dump_json(indent=2) + "\n")
