"""Whole tables: any number of rows in parts of limited size, each hashed as it is written."""

import pytest

from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.parts import Part
from perilune_shared.dataset.schema import OPTIONAL_TABLES, TABLES
from perilune_shared.dataset.whole_tables import WholeTables
from perilune_shared.storage.store import open_store


def test_rows_continue_in_further_parts(little, tmp_path):
    source, store = open_dataset(little), open_store(tmp_path / "set")
    tables = WholeTables(store, max_rows=5)
    for scene_id in source.scene_ids():
        for name, rows in source.scene(scene_id).items():
            tables.add(name, rows)
    written = tables.finish()
    assert tables.counts == source.info.counts
    assert {file.path for file in written} == {item.path for item in store.list()}
    assert all(store.sha256(file.path) == file.sha256 and store.size(file.path) == file.size_bytes for file in written)
    copy = Dataset(store, source.info)
    for name in TABLES:
        assert copy.table(name).equals(source.table(name))
        assert all(Part(store, path, name).n_rows <= 5 for path in copy.parts(name))
    assert copy.parts("frames") == ["manifest/frames/all.parquet", "manifest/frames/all.0001.parquet"]


def test_a_required_table_without_rows_is_one_part(tmp_path):
    written = WholeTables(open_store(tmp_path)).finish()
    assert [file.path for file in written] == [
        f"manifest/{name}/all.parquet" for name in TABLES if name not in OPTIONAL_TABLES
    ]


def test_existing_parts_are_overwritten_only_on_request(little, tmp_path):
    store = open_store(tmp_path)
    first = WholeTables(store).finish()
    with pytest.raises(FileExistsError):
        WholeTables(store).finish()
    tables = WholeTables(store, replace=True)
    tables.add("scenes", open_dataset(little).table("scenes"))
    assert tables.finish()[0] != first[0]
