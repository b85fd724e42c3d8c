"""A dataset is untrusted: Parquet files with invalid columns, footers or pages."""

import os
import pickle

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tests.helpers import hostile_parquet as forged
from tests.helpers.drawn_dataset import seal
from tests.helpers.hostile import assert_refused, part_of, sealed
from tests.sampling import every

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.validation.validate import validate


class Pickled:
    """Unpickling this makes a folder."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def column(table, name, kind, values, nullable=False):
    """Replace a column by one of another type, with the metadata of the original."""

    def damage(root):
        path = part_of(root, table)
        rows = pq.read_table(path)
        place = rows.schema.get_field_index(name)
        cells = pa.array([values] * len(rows), kind)
        field = pa.field(name, kind, nullable=nullable, metadata=rows.schema.field(place).metadata)
        pq.write_table(rows.set_column(place, field, cells), path)

    return sealed(damage)


def table(name, change, **options):
    """Change a whole table as Arrow."""

    def damage(root):
        path = part_of(root, name)
        pq.write_table(change(pq.read_table(path)), path, **options)

    return sealed(damage)


def footer(name, change):
    """Change the footer of a part."""
    return sealed(lambda root: forged.forge(part_of(root, name), change))


def content(name, change):
    """Change the bytes of a part."""

    def damage(root):
        path = part_of(root, name)
        path.write_bytes(change(path.read_bytes()))

    return sealed(damage)


def every_group(change):
    return lambda found: [change(group) for group in forged.groups(found)]


def every_column(change):
    return every_group(lambda group: [change(each) for each in forged.columns(group)])


def with_metadata(**more):
    return lambda rows: rows.replace_schema_metadata(
        {**rows.schema.metadata, **{name.encode(): value for name, value in more.items()}}
    )


def renamed(old, new):
    def change(rows):
        names = [new if name == old else name for name in rows.column_names]
        return rows.rename_columns(names).replace_schema_metadata(rows.schema.metadata)

    return change


def swapped(a, b):
    """Swap two columns."""

    def change(rows):
        names = rows.column_names
        i, j = names.index(a), names.index(b)
        names[i], names[j] = names[j], names[i]
        return rows.select(names)

    return change


def extended(name):
    return lambda rows: rows.append_column(pa.field(name, pa.int64()), pa.array([1] * len(rows)))


def nulled(name):
    """Set the first value of a column to null."""

    def change(rows):
        place = rows.schema.get_field_index(name)
        cells = pa.array([None, *rows[name].to_pylist()[1:]], rows.schema.field(place).type)
        return rows.set_column(place, pa.field(name, cells.type, metadata=rows.schema.field(place).metadata), cells)

    return change


CASES = {
    "text as binary": (column("scenes", "photometry", pa.binary(), b"lambert"), "photometry"),
    "text as a large one": (column("scenes", "photometry", pa.large_string(), "lambert"), "photometry"),
    "text as a struct": (column("frames", "frame_id", pa.struct([("a", pa.string())]), {"a": "x"}), "frame_id"),
    "text as a list": (column("frames", "png_path", pa.list_(pa.string()), ["a"]), "png_path"),
    "text as a map": (column("frames", "split", pa.map_(pa.string(), pa.string()), [("a", "b")]), "split"),
    "text as numbers": (column("frames", "scene_id", pa.int64(), 1), "scene_id"),
    "text as a dictionary": (column("scenes", "photometry", pa.dictionary(pa.int8(), pa.string()), "a"), "photometry"),
    "a number as a pickle": (column("craters", "x_m", pa.binary(), pickle.dumps(1.0)), "x_m"),
    "a number as text": (column("craters", "diameter_m", pa.string(), "=1+1"), "diameter_m"),
    "a number as a whole one": (column("craters", "depth_m", pa.int64(), 1), "depth_m"),
    "a number in 32 bits": (column("craters", "z_m", pa.float32(), 1.0), "z_m"),
    "a whole number as a real one": (column("labels", "crater_id", pa.float64(), 1.5), "crater_id"),
    "a whole number as a time": (column("frames", "frame_index", pa.timestamp("ns"), 1), "frame_index"),
    "a vector as a list of any length": (
        column("frames", "position_m", pa.list_(pa.float64()), [0.0] * 3),
        "position_m",
    ),
    "a vector of four": (column("frames", "position_m", pa.list_(pa.float64(), 4), [0.0] * 4), "position_m"),
    "a vector as text": (column("frames", "rotation_wxyz", pa.string(), "[1,0,0,0]"), "rotation_wxyz"),
    "a missing column": (table("frames", lambda rows: rows.drop_columns("png_path")), "schema"),
    "a column of an odd name": (table("frames", extended("extra column")), "schema"),
    "a column named like a method": (table("frames", extended("__class__")), "schema"),
    "a column named by HTML": (table("frames", extended("<script>")), "schema"),
    "a column named by a command": (table("labels", renamed("crater_id", "$(touch canary)")), "schema"),
    "a column twice": (table("labels", renamed("crater_id", "frame_id")), "schema"),
    "columns in another order": (table("craters", swapped("x_m", "y_m")), "schema"),
    "columns under each other's names": (
        table("craters", lambda rows: rows.set_column(2, rows.schema.field(2), rows["y_m"])),
        "longitude_deg",
    ),
    "no metadata": (table("scenes", lambda rows: rows.replace_schema_metadata(None)), "schema_version"),
    "another table": (table("scenes", with_metadata(**{"perilune.table": "frames"})), "perilune.table"),
    "another version": (table("scenes", with_metadata(**{"perilune.schema_version": "\x1b[2J"})), "schema_version"),
    "another unit": (
        table(
            "craters", lambda rows: rows.cast(rows.schema.set(2, rows.schema.field(2).with_metadata({"unit": "km"})))
        ),
        "x_m",
    ),
    "null for a number": (table("craters", nulled("x_m")), "x_m"),
    "null for a name": (table("frames", nulled("frame_id")), "frame_id"),
    "null for a path": (table("frames", nulled("png_path")), "png_path"),
    "text of 2000 letters": (column("scenes", "photometry", pa.string(), "a" * 2000), "photometry"),
    "no rows": (table("frames", lambda rows: rows[:0]), ""),
    "an empty file": (content("frames", lambda whole: b""), "content"),
    "a file of its ends": (content("frames", lambda whole: b"PAR1PAR1"), "content"),
    "a footer longer than its file": (content("frames", lambda whole: whole[:-8] + b"\xff\xff\xff\x7fPAR1"), "content"),
    "a footer of nothing": (content("frames", lambda whole: whole[:-8] + bytes(4) + b"PAR1"), "content"),
    "a footer of noise": (
        content("frames", lambda whole: whole[:-508] + np.random.default_rng(1).bytes(500) + whole[-8:]),
        "content",
    ),
    "an encrypted file": (content("frames", lambda whole: b"PARE" + whole[4:-4] + b"PARE"), "content"),
    "pages of noise": (
        content("frames", lambda whole: whole[:4] + np.random.default_rng(1).bytes(2000) + whole[2004:]),
        "",
    ),
    "a CSV file": (content("frames", lambda whole: b"frame_id\n=cmd()\n"), "content"),
    "a schema nested 100 000 deep": (content("frames", lambda whole: forged.nested(100_000)), "content"),
    "a schema nested 3000 deep": (content("frames", lambda whole: forged.nested(3000)), ""),
    "more rows than its groups": (footer("frames", lambda found: forged.put(found, 3, 10**9)), "rows"),
    "negative rows": (footer("frames", lambda found: forged.put(found, 3, -1)), ""),
    "negative rows in a group": (footer("frames", every_group(lambda group: forged.put(group, 3, -5))), ""),
    "10^12 rows in a group": (footer("frames", every_group(lambda group: forged.put(group, 3, 10**12))), "rows"),
    "groups that lie over each other": (
        footer(
            "labels", lambda found: [forged.groups(found).extend(forged.groups(found) * 9), forged.put(found, 3, 10**9)]
        ),
        "rows",
    ),
    "columns of no size": (footer("frames", every_column(lambda each: forged.put(each, 6, 0))), "frame_id"),
    "columns beyond the file": (
        footer("frames", every_column(lambda each: each.update(dict.fromkeys((9, 11), (6, 10**9))))),
        "",
    ),
    "columns before the file": (footer("frames", every_column(lambda each: forged.put(each, 9, -5))), ""),
    "columns in each other's place": (
        footer("craters", every_column(lambda each: each.update({9: (6, 4)}))),
        "",
    ),
    "more values than rows": (footer("labels", every_column(lambda each: forged.put(each, 5, 10**9))), ""),
    "fewer values than rows": (footer("labels", every_column(lambda each: forged.put(each, 5, 1))), ""),
}


@pytest.mark.parametrize("name", every(3, CASES))
def test_hostile_parts_are_refused(name, victim, capsys, monkeypatch):
    damage, name_of_column = CASES[name]
    damage(victim)
    assert_refused(victim, "", name_of_column, capsys, monkeypatch)


def test_unknown_columns_are_ignored_and_never_read(victim):
    """Whatever they contain: long lists, long texts, pickles."""
    part = part_of(victim, "frames")
    rows = pq.read_table(part)
    n = len(rows)
    for name, cells in (
        ("later_list", pa.array([[1.0] * 1000] * n)),
        ("later_text", pa.array(["x" * 100_000] * n)),
        ("later_pickle", pa.array([pickle.dumps(Pickled(victim.parent / "canary" / "made"))] * n)),
    ):
        rows = rows.add_column(1, name, cells)
    before = open_dataset(victim).table("frames")
    pq.write_table(rows, part)
    seal(victim)
    assert validate(open_dataset(victim)) == []
    assert open_dataset(victim).table("frames").equals(before)


def test_a_known_column_between_unknown_ones_keeps_its_checks(victim):
    """A known column of another type is an error, and so is a name that differs only in case."""
    part = part_of(victim, "craters")
    rows = pq.read_table(part)
    wrong = rows.set_column(2, "x_m", rows["x_m"].cast(pa.float32())).append_column("later", pa.nulls(len(rows)))
    pq.write_table(wrong, part)
    with pytest.raises(UserError, match="x_m: got float"):
        open_dataset(victim).table("craters")
    pq.write_table(renamed("x_m", "X_M")(rows), part)
    with pytest.raises(UserError, match="no x_m"):
        open_dataset(victim).table("craters", ["x_m"])


def test_pickles_are_never_loaded(victim, capsys, monkeypatch):
    """Pickles in the metadata of the file, of a column, of pandas and of a Python extension type."""
    bait = victim.parent / "canary" / "made"
    pickled = pickle.dumps(Pickled(bait))
    path = part_of(victim, "scenes")
    rows = pq.read_table(path)
    fields = [field.with_metadata({**field.metadata, b"pickle": pickled}) for field in rows.schema]
    fields[-1] = fields[-1].with_metadata(
        {b"ARROW:extension:name": b"arrow.py_extension_type", b"ARROW:extension:metadata": pickled}
    )
    metadata = {**rows.schema.metadata, b"pandas": pickled, b"pickle": pickled, b"huggingface": pickled}
    pq.write_table(rows.cast(pa.schema(fields, metadata)), path)
    sealed(lambda root: None)(victim)
    assert_refused(victim, "manifest/scenes/all.parquet", "scene_id", capsys, monkeypatch)
    assert not bait.exists()
    pickle.loads(pickled)  # noqa: S301 - shows that unpickling would run code
    assert bait.is_dir()
