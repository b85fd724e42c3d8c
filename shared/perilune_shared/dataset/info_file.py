"""Read and write dataset.json, which may be untrusted."""

import hashlib
import json
import math
from typing import Any

from pydantic import ValidationError

from perilune_shared.config.errors import expected_of, got_of
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.schema import SCHEMA_VERSION, TABLES
from perilune_shared.errors import UserError, shortened
from perilune_shared.storage.store import Address, Store, open_store

INFO_NAME = "dataset.json"
_OWN_HASH = "sha256"
_LARGEST_INFO_BYTES = 10_000_000
_EXPECTED = "the folder or address of a dataset (see `make dataset`)"


def read_object(address: Address) -> dict[str, Any]:
    """Read the JSON object in dataset.json.

    Raises UserError if it is missing, too large or not a JSON object.
    """
    store = open_store(address)
    where = store.at(INFO_NAME)
    if store.folder is not None:
        path = store.folder / INFO_NAME
        if not path.exists() and not path.is_symlink():
            subfolders = [
                f"{store.folder / kind}" for kind in ("detect", "nav") if (store.folder / kind / INFO_NAME).is_file()
            ]
            raise UserError(store, INFO_NAME, "no such file", " or ".join(subfolders) or _EXPECTED)
        store.plain_size(INFO_NAME)
    try:
        text = store.read(INFO_NAME, most_bytes=_LARGEST_INFO_BYTES)
    except UserError as error:
        if error.field == "file" and not store.is_local:
            raise UserError(store, INFO_NAME, error.found, _EXPECTED) from None
        raise
    try:
        content = json.loads(text, object_pairs_hook=_with_unique_names, parse_constant=_finite, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise UserError(where, "content", error, "JSON") from None
    if not isinstance(content, dict):
        raise UserError(where, "content", type(content).__name__, "a JSON object")
    content.pop(_OWN_HASH, None)
    return content


def _with_unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the members of a JSON object as a dict.

    Raises ValueError on a duplicate name, since JSON readers disagree on which member is valid.
    """
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


def read_info(address: Address) -> DatasetInfo:
    """Read dataset.json. Raises UserError if it is missing or damaged, or has another schema version."""
    store = open_store(address)
    content = read_object(store)
    for name in ("manifest", "shards", *(f"manifest/{table}" for table in TABLES)):
        if store.folder is not None and (store.folder / name).is_symlink():
            raise UserError(store.at(name), "folder", "a link", "a folder")
    if content.get("images") == "packed" and store.folder is not None and (store.folder / "images").exists():
        expected = "frames in shards/; unpack the dataset with the version of perilune that packed it"
        raise UserError(store.at(INFO_NAME), "images", "frames in images/*.parquet", expected)
    version = content.get("schema_version")
    if version != SCHEMA_VERSION:
        expected = f"{SCHEMA_VERSION}; see `perilune-manifest migrate`"
        raise UserError(store.at(INFO_NAME), "schema_version", version, expected)
    return checked_info(content, store.at(INFO_NAME))


def checked_info(content: dict[str, Any], path: object) -> DatasetInfo:
    """Return plain data as a validated DatasetInfo. Raises UserError on the first wrong field of `path`."""
    try:
        info = DatasetInfo.model_validate_json(json.dumps(content))
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in fault["loc"])
        raise UserError(path, field or "content", got_of(fault), expected_of(fault)) from None
    except RecursionError as error:
        raise UserError(path, "content", error, "JSON with fewer levels") from None
    _check_texts(info, path)
    for key, recipe in info.recipes.items():
        if recipe.key != key:
            raise UserError(path, "recipes", f"the key {key}", f"{recipe.key}, the hash of the recipe")
    return info


def _check_texts(info: DatasetInfo, path: object) -> None:
    """Check the texts of recipes: they are untrusted and are shown on pages and terminals."""
    for recipe in info.recipes.values():
        unsafe = _unsafe_text([recipe.config, recipe.developed_from.camera_config if recipe.developed_from else None])
        if unsafe is not None:
            raise UserError(path, "recipes", repr(unsafe), "plain text, without <, >, &, $, ` and control characters")


def _unsafe_text(tree: object) -> str | None:
    """Return the first text or member name with unsafe characters in plain data, or None if all are safe."""
    if isinstance(tree, str):
        return None if tree.isprintable() and not set(tree) & set("<>&`$") else tree
    if isinstance(tree, dict):
        tree = [*tree, *tree.values()]
    if isinstance(tree, list):
        return next((unsafe for unsafe in map(_unsafe_text, tree) if unsafe is not None), None)
    return None


def write_info(address: Address, info: DatasetInfo) -> None:
    """Write dataset.json atomically. Raises UserError if a text of a recipe has unsafe characters."""
    store = open_store(address)
    store.replace(INFO_NAME, info_bytes(info, store.at(INFO_NAME)))


def info_bytes(info: DatasetInfo, where: object) -> bytes:
    """Return the content of dataset.json.

    Raises UserError if a text of a recipe has unsafe characters. Messages name `where`.
    """
    _check_texts(info, where)
    return with_own_hash(info.model_dump_json(indent=2).encode())


def with_own_hash(content: bytes) -> bytes:
    """Return a JSON object with an added last member `sha256`: the hash of the text before it."""
    head = content.rstrip().removesuffix(b"}").rstrip()
    return head + f',\n  "{_OWN_HASH}": "{hashlib.sha256(head).hexdigest()}"\n}}\n'.encode()


def has_own_hash(store: Store) -> bool:
    """Whether dataset.json matches the hash that it contains, so that it was not edited by hand."""
    content = store.read(INFO_NAME, most_bytes=_LARGEST_INFO_BYTES)
    head, _, _ = content.rpartition(f',\n  "{_OWN_HASH}": '.encode())
    return with_own_hash(head + b"}") == content
