"""A dataset is untrusted: small files that would decompress to much memory, or take very long to read."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tests.helpers import hostile_parquet as forged
from tests.helpers.hostile import faults_within_limits, pack, part_of, sealed

from perilune_shared.dataset.packed import SHARDS
from perilune_shared.dataset.parts import Part
from perilune_shared.dataset.schema import TABLES
from perilune_shared.errors import UserError
from perilune_shared.storage.store import open_store


def constant(n, **cells):
    """Return rows of `scenes` that compress to few bytes."""
    values = {"string": "a", "int64": 1, "double": 1.0}
    columns = [pa.array([values[str(field.type)]] * n, field.type) for field in TABLES["scenes"]]
    rows = pa.table(columns, schema=TABLES["scenes"])
    for name, value in cells.items():
        rows = rows.set_column(rows.schema.get_field_index(name), TABLES["scenes"].field(name), value)
    return rows


def scenes(rows, change=None, **options):
    """Write the part of `scenes` from other rows, then change its footer."""

    def damage(root):
        path = part_of(root, "scenes")
        pq.write_table(rows(), path, **options)
        if change is not None:
            forged.forge(path, change)

    return damage


def thousandfold(found):
    """Repeat each row group a thousand times and adapt the sums."""
    forged.groups(found)[:] = forged.groups(found) * 1000
    forged.put(found, 3, found[3][1] * 1000)


def small(found):
    """Change a footer so that it states small columns without dictionaries."""
    for group in forged.groups(found):
        forged.put(group, 2, 1000)
        for each in forged.columns(group):
            forged.put(each, 6, 100)
            each.pop(11, None)


def long_text(n, length):
    return lambda: constant(n, photometry=pa.array(["x" * length + str(i) for i in range(n)]))


def repeated_text():
    return constant(40, photometry=pa.array(["x" * 10_000_000] * 40))


def long_list(root):
    """Put 10^8 numbers in one row of a vector."""
    path = part_of(root, "trajectories")
    rows = pq.read_table(path)
    place = rows.schema.get_field_index("nominal_position_m")
    flat = pa.array(np.zeros(20_000_000))
    cells = pa.ListArray.from_arrays(pa.array([0, len(flat), len(flat)], pa.int32()), flat)
    pq.write_table(rows.set_column(place, pa.field("nominal_position_m", cells.type), cells), path)


def one_image_repeated(root):
    pack(root, lambda rows: rows.__delitem__(slice(1, None)), compression="zstd")
    path = root / "shards/train-00000-of-00001.parquet"
    rows = pq.read_table(path)
    image = pa.array([{"bytes": b"\x89PNG" + bytes(40_000_000), "path": "a"}], SHARDS.field("image").type)
    rows = rows.set_column(rows.schema.get_field_index("image"), SHARDS.field("image"), image)
    with pq.ParquetWriter(path, SHARDS, compression="zstd") as writer:
        for _ in range(6):
            writer.write_table(rows)


def one_label_repeated(change=None):
    """Give one frame 3 x 10^6 equal labels, which take few bytes by a dictionary or in run lengths."""

    def damage(root):
        pack(root, lambda rows: rows.__delitem__(slice(1, None)))
        path = root / "shards/train-00000-of-00001.parquet"
        rows = pq.read_table(path)
        label = rows["labels"].combine_chunks().values.slice(0, 1)
        many = label.take(pa.array(np.zeros(3_000_000, np.int32)))
        lists = pa.ListArray.from_arrays(pa.array([0, len(many)], pa.int32()), many).cast(SHARDS.field("labels").type)
        rows = rows.set_column(rows.schema.get_field_index("labels"), SHARDS.field("labels"), lists)
        pq.write_table(rows, path, compression="zstd")
        if change is not None:
            forged.forge(path, change)

    return damage


def few_values(found):
    """Change a footer so that it states few labels."""
    for group in forged.groups(found):
        for each in forged.columns(group)[-13:]:
            forged.put(each, 5, 100)


BOMBS = {
    "10^9 rows": (scenes(lambda: constant(1_000_000), thousandfold), "rows"),
    "10^6 rows in 20 kB": (scenes(lambda: constant(1_000_000)), "rows"),
    "text of 100 MB in 20 kB": (scenes(long_text(10, 10_000_000), compression="zstd", use_dictionary=False), "size"),
    "the same with gzip": (scenes(long_text(10, 10_000_000), compression="gzip", use_dictionary=False), "size"),
    "the same with a footer that hides it": (
        scenes(long_text(10, 10_000_000), small, compression="zstd", use_dictionary=False),
        "manifest/scenes",
    ),
    "text of 10 MB in 40 rows": (scenes(repeated_text, dictionary_pagesize_limit=2**30), "photometry"),
    "the same with a footer that hides it, by its dictionary": (
        scenes(repeated_text, small, dictionary_pagesize_limit=2**30),
        "manifest/scenes",
    ),
    "2 x 10^7 numbers in a row": (long_list, "nominal_position_m"),
    "images of 240 MB in 60 kB": (one_image_repeated, "size"),
    "3 x 10^6 labels of one frame": (one_label_repeated(), "labels.list.element"),
    "the same with a footer that hides it, by its values": (one_label_repeated(few_values), "labels.list.element"),
}


QUICK = ("10^6 rows in 20 kB", "the same with a footer that hides it", "3 x 10^6 labels of one frame")
"""One of each kind, since each takes a process of its own."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=[] if n in QUICK else [pytest.mark.slow]) for n in BOMBS])
def test_bombs_are_refused_within_memory_and_time_limits(name, victim):
    damage, column = BOMBS[name]
    sealed(damage)(victim)
    assert sum(path.stat().st_size for path in victim.rglob("*") if path.is_file()) < 3_000_000
    assert column in faults_within_limits(victim, 80)


def test_the_largest_real_part_is_read(tmp_path):
    """The limits accept what the renderer writes: numbers that hardly compress."""
    rng = np.random.default_rng(1)
    texts = {"frame_id": "s000/t000/%06d", "scene_id": "s%03d", "split": "train%d"}
    columns = [
        pa.array([texts[field.name] % (i % 1000) for i in range(300_000)])
        if field.name in texts
        else pa.array(rng.integers(0, 2**40, 300_000) if field.type == pa.int64() else rng.random(300_000))
        for field in TABLES["labels"]
    ]
    pq.write_table(pa.table(columns, schema=TABLES["labels"]), tmp_path / "all.parquet", compression="zstd")
    assert len(Part(open_store(tmp_path), "all.parquet", "labels").read()) == 300_000
    with pytest.raises(UserError, match=r"perilune\.table"):
        Part(open_store(tmp_path), "all.parquet", "frames")
