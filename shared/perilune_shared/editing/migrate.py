"""Convert datasets of older schema versions to the current one.

Version 2 added the column `origin` to `craters` and made age and fresh depth nullable. Version 3 added recipe and
content hash to `scenes`, `contrast` to `labels`, hashes of all files, and the state of the frames (`images`).
Version 4 added `scene_id` and `split` to `labels`, and made the real columns of `labels` float32.
"""

from collections.abc import Callable, Mapping
from typing import Any

import pyarrow as pa
from pydantic import ValidationError

from perilune_shared.config.errors import expected_of, got_of
from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.content import content_sha256
from perilune_shared.dataset.info_file import INFO_NAME, checked_info, read_object
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo, Recipe
from perilune_shared.dataset.parts import Part
from perilune_shared.dataset.schema import MAY_BE_ABSENT, SCHEMA_VERSION, TABLES, complete
from perilune_shared.editing.writer import new_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address, Store, open_store

_ADDED_IN_4 = {"labels": ("scene_id", "split")}
_ADDED_IN_3 = {"scenes": ("recipe", "content_sha256"), "labels": ("contrast",)}
_ADDED_IN_2 = {"craters": ("origin",)}


def _without(tables: dict[str, pa.Schema], added: Mapping[str, tuple[str, ...]]) -> dict[str, pa.Schema]:
    remaining = {}
    for name, schema in tables.items():
        remaining[name] = pa.schema([field for field in schema if field.name not in added.get(name, ())])
    return remaining


def _with_float64(schema: pa.Schema) -> pa.Schema:
    return pa.schema([field.with_type(pa.float64()) if field.type == pa.float32() else field for field in schema])


_TABLES_3 = {name: _with_float64(schema) for name, schema in _without(TABLES, _ADDED_IN_4).items()}
_TABLES_2 = _without(_without(_TABLES_3, MAY_BE_ABSENT), _ADDED_IN_3)
OLD_TABLES = {"1": _without(_TABLES_2, _ADDED_IN_2), "2": _TABLES_2, "3": _TABLES_3}
"""Schemas of the tables in older versions."""


def migrate(address: Address, out: Address, progress: Progress = NO_PROGRESS, *, link: bool = False) -> None:
    """Convert a dataset of an older schema version to the current one.

    Frames are copied, or hard-linked with `link`. The contrast of labels becomes null for versions 1 and 2, which did
    not record it. Raises UserError if the dataset has the current version already, is damaged or incomplete, or has
    packed frames.
    """
    store = open_store(address)
    content, path = read_object(store), store.at(INFO_NAME)
    version = content.get("schema_version")
    if version == SCHEMA_VERSION:
        raise UserError(path, "schema_version", version, "an older version: this is the current one")
    if not isinstance(version, str) or version not in OLD_TABLES:
        raise UserError(path, "schema_version", version, f"one of {', '.join(OLD_TABLES)}")
    if content.get("complete") is not True:
        raise UserError(path, "complete", content.get("complete"), "a finished dataset")
    if content.get("images") == "packed":
        expected = "frames as files; unpack it with the version of perilune that packed it"
        raise UserError(path, "images", "packed", expected)
    info = _info(content, path)
    source = _OldDataset(store, info, version)
    scene_ids = sorted(source.rows("scenes")["scene_id"].to_pylist())
    task = progress.add_task("migrating", total=len(scene_ids), unit="scenes")
    with new_dataset(out, info) as writer:
        for scene_id in scene_ids:
            tables = {name: source.rows(name, scene_id) for name in TABLES}
            writer.add_scene(tables)
            names = {name: name for name in tables["frames"]["frame_id"].to_pylist()}
            if info.images == "files":
                writer.add_images(source, tables["frames"], names, link=link)
            progress.advance(task)


def _info(content: dict[str, Any], path: str) -> DatasetInfo:
    """Convert dataset.json. In versions 1 and 2, the fields of the only recipe are at the top level."""
    version = content["schema_version"]
    line = f"migrated from schema version {version}"
    if version == "3":
        history = content.get("history", [])
        history = [*history, line] if isinstance(history, list) else history
        return checked_info({**content, "schema_version": SCHEMA_VERSION, "history": history}, path)
    missing = [name for name in ("preset", "kind", "seed", "config", "versions") if name not in content]
    if missing:
        raise UserError(path, missing[0], "nothing", f"a value, as in every dataset of version {version}")
    recipe_fields = {name: content.pop(name) for name in ("preset", "seed", "config", "versions")}
    origin = content.pop("developed_from", None)
    if isinstance(origin, dict):
        origin = {**origin, "camera_config": None}
    try:
        recipe = Recipe.model_validate({**recipe_fields, "kind": content["kind"], "developed_from": origin})
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in fault["loc"])
        raise UserError(path, field or "config", got_of(fault), expected_of(fault)) from None
    return checked_info(
        {
            **content,
            "schema_version": SCHEMA_VERSION,
            "images": "files",
            "recipes": {recipe.key: recipe.model_dump(mode="json")},
            "history": [line],
        },
        path,
    )


class _OldDataset(Dataset):
    """A dataset of an older schema version. `rows` converts its rows to the current version."""

    def __init__(self, store: Store, info: DatasetInfo, version: str):
        super().__init__(store, info)
        self.version = version

    def rows(self, table: str, scene_id: str | None = None) -> pa.Table:
        """Read a table: the rows of one scene with the current columns, or all rows with the old columns."""
        schema = OLD_TABLES[self.version][table]
        pieces = [Part(self.store, part, table, schema, self.version).read() for part in self.parts(table, scene_id)]
        rows = pa.concat_tables(pieces) if pieces else schema.empty_table()
        if scene_id is None:
            return rows
        rows = self._of_scene(table, rows, scene_id)
        columns = {
            name: rows[name] if name in schema.names else self._added(table, name, rows, scene_id)
            for name in TABLES[table].names
            if name in schema.names or name not in MAY_BE_ABSENT.get(table, ())
        }
        return complete(table, pa.table(columns))

    def _of_scene(self, table: str, rows: pa.Table, scene_id: str) -> pa.Table:
        key = "scene_id" if "scene_id" in rows.column_names else "frame_id"
        values = rows[key].to_pylist()
        in_scene = [value == scene_id if key == "scene_id" else value.startswith(f"{scene_id}/") for value in values]
        return rows.filter(pa.array(in_scene, pa.bool_()))

    def _splits(self, frame_ids: pa.ChunkedArray, scene_id: str) -> list[str | None]:
        frames = self.rows("frames", scene_id)
        split_of = dict(zip(frames["frame_id"].to_pylist(), frames["split"].to_pylist(), strict=True))
        return [split_of.get(frame_id) for frame_id in frame_ids.to_pylist()]

    def _added(self, table: str, name: str, rows: pa.Table, scene_id: str) -> pa.Array:
        """Return the values of a column that the older version lacks."""
        n = len(rows)
        fill: dict[tuple[str, str], Callable[[], list]] = {
            ("labels", "scene_id"): lambda: [scene_id] * n,
            ("labels", "split"): lambda: self._splits(rows["frame_id"], scene_id),
            # Before version 2 there were no clusters and no catalogues, so all craters were primary.
            ("craters", "origin"): lambda: ["primary"] * n,
            ("labels", "contrast"): lambda: [None] * n,
            ("scenes", "recipe"): lambda: [self.info.recipe().key] * n,
            ("scenes", "content_sha256"): lambda: (
                [content_sha256(self.rows("craters", scene_id), self.rows("boulders", scene_id))] * n
            ),
        }
        return pa.array(fill[table, name](), TABLES[table].field(name).type)
