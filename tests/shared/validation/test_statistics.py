"""Statistics in the footer of a part that differ from its values hide rows from readers; `validate` finds them."""

import struct

import pyarrow.parquet as pq
import pytest
from tests.helpers import hostile_parquet as forged
from tests.helpers.hostile import command, digest, faults_in_output, pack, part_of, sealed

from perilune_shared.dataset.expression import Condition
from perilune_shared.dataset.index import read_index
from perilune_shared.dataset.info_file import write_info
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.metadata import IndexPart
from perilune_shared.editing.subset import subset
from perilune_shared.errors import UserError
from perilune_shared.validation.validate import validate

_I64, _TEXT, _STRUCT = 6, 8, 12
"""Types of Thrift."""


def chunk_of(path, column, group=0):
    """Return a function of a footer that returns the ColumnChunk of a column."""
    place = pq.read_metadata(path).row_group(group).to_dict()["columns"]
    (number,) = [n for n, one in enumerate(place) if one["path_in_schema"] == column]
    return lambda footer: forged.groups(footer)[group][1][1][1][number]


def changed(path, column, **fields):
    """Change statistics of a column by number of parquet.thrift: f1 and f2, or f5 and f6, are maximum and minimum."""
    found = chunk_of(path, column)

    def change(footer):
        statistics = found(footer)[3][1][12][1]
        for name, value in fields.items():
            number = int(name[1:])
            statistics[number] = (_I64 if isinstance(value, int) else _TEXT, value)

    forged.forge(path, change)


def number(value):
    return struct.pack("<d", value)


STATISTICS = {
    "another scene": ("scenes", "scene_id", {"f5": b"s555", "f6": b"s555"}),
    "another split": ("frames", "split", {"f5": b"test", "f6": b"test"}),
    "frames of another scene": ("labels", "frame_id", {"f5": b"s555/t0/0", "f6": b"s555/t0/0"}),
    "lower times": ("frames", "time_s", {"f5": number(-1.0), "f6": number(-2.0)}),
    "older fields": ("frames", "time_s", {"f1": number(-1.0), "f2": number(-2.0)}),
    "a wider range": ("frames", "time_s", {"f5": number(1e9)}),
    "not a number": ("frames", "time_s", {"f5": number(float("nan"))}),
    "only nulls": ("frames", "time_s", {"f3": 6}),
    "fewer nulls": ("frames", "exr_path", {"f3": 0}),
    "values where there is none": ("frames", "exr_path", {"f5": b"z", "f6": b"a"}),
    "distinct values": ("frames", "split", {"f4": 1}),
    "of a vector": ("frames", "position_m.list.element", {"f5": number(0.0), "f6": number(0.0)}),
    "of float32": ("labels", "radius_px", {"f5": struct.pack("<f", 1.0), "f6": struct.pack("<f", 0.5)}),
    "of integers": ("craters", "crater_id", {"f5": struct.pack("<q", -1), "f6": struct.pack("<q", -2)}),
}


@pytest.mark.parametrize("name", STATISTICS)
def test_false_statistics_are_found(name, victim, capsys, monkeypatch):
    table, column, fields = STATISTICS[name]
    sealed(lambda root: changed(part_of(root, table), column, **fields))(victim)
    faults = faults_in_output(command(victim, "validate", capsys, monkeypatch))
    assert (f"manifest/{table}/all.parquet", column) in faults


def ignored_writer(path):
    """Name a writer whose statistics pyarrow ignores, though other programs use them."""
    forged.forge(path, lambda footer: footer.__setitem__(6, (_TEXT, b"parquet-mr version 1.0.0 (build x)")))


def test_statistics_of_writers_that_pyarrow_ignores_are_checked(victim):
    path = part_of(victim, "scenes")
    changed(path, "scene_id", f5=b"s555", f6=b"s555")
    sealed(lambda root: ignored_writer(path))(victim)
    assert ("manifest/scenes/all.parquet", "scene_id") in [
        (one.file, one.column) for one in validate(open_dataset(victim))
    ]


def added(part, number, value, kind=_I64, column="scene_id"):
    found = chunk_of(part, column)
    forged.forge(part, lambda footer: found(footer).__setitem__(number, (kind, value)))


def of_metadata(part, number, value, kind=_I64):
    found = chunk_of(part, "scene_id")
    forged.forge(part, lambda footer: found(footer)[3][1].__setitem__(number, (kind, value)))


def sorted_by(part):
    """State that rows are in descending order of the first column."""
    order = (9, (_STRUCT, [{1: (5, 0), 2: (1, True), 3: (2, False)}]))
    forged.forge(part, lambda footer: forged.groups(footer)[0].__setitem__(4, order))


def with_page_index(part):
    table = pq.read_table(part)
    pq.write_table(table, part, write_page_index=True)


def swapped_names(part):
    """State that two columns have each other's values; pyarrow uses the schema, other programs these names."""

    def change(footer):
        columns = forged.columns(forged.groups(footer)[0])
        first, second = columns[1][3], columns[2][3]
        columns[1][3], columns[2][3] = second, first

    forged.forge(part, change)


OTHERS = {
    "a page index": (with_page_index, "a page index"),
    "a Bloom filter": (lambda part: of_metadata(part, 14, 4), "a Bloom filter"),
    "a sort order": (sorted_by, "a sort order"),
    "another file": (lambda part: added(part, 1, b"other.parquet", _TEXT), "another file"),
    "swapped names": (swapped_names, "the name"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_statements_about_rows_are_refused(name, victim):
    damage, expected = OTHERS[name]
    sealed(lambda root: damage(part_of(root, "frames")))(victim)
    found = [one.found for one in validate(open_dataset(victim)) if one.file == "manifest/frames/all.parquet"]
    assert any(expected in text for text in found), found


@pytest.mark.parametrize("column", ["frame_id", "image.bytes", "labels.list.element.radius_px"])
def test_false_statistics_of_shards_are_found(column, victim):
    def damage(root):
        pack(root)
        value = struct.pack("<f", 0.0) if "radius" in column else b"a"
        changed(root / "shards/train-00000-of-00001.parquet", column, f5=value, f6=value)

    sealed(damage)(victim)
    assert ("shards/train-00000-of-00001.parquet", column) in [
        (one.file, one.column) for one in validate(open_dataset(victim))
    ]


def test_nulls_of_nested_columns_are_checked(victim):
    def damage(root):
        pack(root)
        changed(root / "shards/train-00000-of-00001.parquet", "labels.list.element.radius_px", f3=10_000)

    sealed(damage)(victim)
    assert any("nulls" in one.found for one in validate(open_dataset(victim)))


def hiding(root):
    """Hide the frames of the first scene from readers of the split train, and from conditions on time."""
    path = part_of(root, "frames")
    pq.write_table(pq.read_table(path), path, row_group_size=3)
    changed(path, "split", f5=b"val", f6=b"val")


def test_a_dataset_with_hidden_rows_is_not_edited(victim, tmp_path):
    sealed(hiding)(victim)
    dataset = open_dataset(victim)
    assert not len(dataset.table("frames", split="train"))
    with pytest.raises(UserError, match="split: got max val in the statistics"):
        subset(dataset, tmp_path / "out", ["time_s >= 0"])


def test_a_condition_does_not_trust_statistics(victim, tmp_path):
    """Those of other columns than ids and splits are not checked before an edit."""
    path = part_of(victim, "frames")
    sealed(lambda root: changed(path, "time_s", f5=number(-1.0), f6=number(-2.0)))(victim)
    assert not len(open_dataset(victim).table("frames", where=Condition("time_s >= 0")))
    subset(open_dataset(victim), tmp_path / "out", ["time_s >= 0"])
    assert len(open_dataset(tmp_path / "out")) == len(open_dataset(victim))


def test_a_false_index_is_found(victim):
    (path,) = (victim / "index").glob("*.parquet")
    changed(path, "path", f5=b"z", f6=b"z")
    content = path.read_bytes()
    new = path.with_name(f"{digest(content)[:16]}.parquet")
    path.rename(new)
    info = open_dataset(victim).info
    part = IndexPart(path=f"index/{new.name}", bytes=len(content), sha256=digest(content))
    write_info(victim, info.model_copy(update={"index": (part,)}))
    with pytest.raises(UserError, match="max z in the statistics"):
        read_index(open_dataset(victim).store, open_dataset(victim).info)
    assert [one.column for one in validate(open_dataset(victim))] == ["path"]
