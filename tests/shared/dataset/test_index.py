"""The index names every file of a dataset; it is never overwritten, and an invalid one is refused in one line."""

import hashlib
import os

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from perilune_shared.dataset import index
from perilune_shared.dataset.index import INDEX, frame_rows, index_rows, read_index, seal, write_index
from perilune_shared.dataset.info_file import read_info
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.metadata import IndexPart
from perilune_shared.dataset.parts import WrittenFile
from perilune_shared.errors import UserError
from perilune_shared.storage.store import open_store

_ROWS = index_rows([WrittenFile.of("b.txt", b"1"), WrittenFile.of("a/b.txt", b"22"), WrittenFile.of("a-b.txt", b"")])


@pytest.fixture
def info(little):
    return open_dataset(little).info


def test_rows_are_sorted_and_hashed():
    assert _ROWS.schema.equals(INDEX, check_metadata=True)
    assert _ROWS["path"].to_pylist() == ["a-b.txt", "a/b.txt", "b.txt"]
    assert _ROWS["bytes"].to_pylist() == [0, 2, 1]
    assert _ROWS["sha256"][2].as_py() == hashlib.sha256(b"1").hexdigest()


def test_frame_rows_are_those_of_the_table(little):
    frames = open_dataset(little).table("frames")
    rows = frame_rows(frames)
    assert rows["path"].to_pylist() == frames["png_path"].to_pylist()
    assert rows["sha256"].to_pylist() == frames["png_sha256"].to_pylist()
    place = frames.schema.get_field_index("png_sha256")
    with pytest.raises(UserError, match=r"png_sha256.*null"):
        frame_rows(frames.set_column(place, frames.schema.field(place), pa.nulls(len(frames), pa.string())))


def test_a_written_index_is_read_again(tmp_path, info):
    store = open_store(tmp_path)
    written = seal(store, info, _ROWS.take([2, 0, 1]))
    assert read_info(store) == written
    (part,) = written.index
    content = (tmp_path / part.path).read_bytes()
    assert part.sha256 == hashlib.sha256(content).hexdigest() and part.bytes == len(content)
    assert part.path == f"index/{part.sha256[:16]}.parquet"
    assert read_index(store, written).equals(_ROWS)


def test_a_long_index_has_several_parts(tmp_path, info, monkeypatch):
    monkeypatch.setattr(index, "MAX_ROWS", 2)
    monkeypatch.setattr(index, "_ROWS_PER_GROUP", 1)
    store = open_store(tmp_path)
    written = seal(store, info, _ROWS)
    assert len(written.index) == 2
    assert read_index(store, written)["path"].to_pylist() == _ROWS["path"].to_pylist()
    reversed_parts = written.model_copy(update={"index": written.index[::-1]})
    with pytest.raises(UserError, match="repeated or unsorted paths"):
        read_index(store, reversed_parts)


def test_a_new_index_replaces_the_old_one_and_leftovers(tmp_path, info):
    store = open_store(tmp_path)
    old = seal(store, info, _ROWS)
    store.write("index/0123456789abcdef.parquet", b"left by a killed process")
    new = seal(store, old, _ROWS[:1])
    assert [item.path for item in store.list("index")] == [new.index[0].path] != [old.index[0].path]
    assert [item.path for item in store.list("index")] == [part.path for part in seal(store, new, _ROWS[:1]).index]


def written(store, rows, **options):
    """Write any rows as an index; return its record."""
    sink = pa.BufferOutputStream()
    pq.write_table(rows, sink, **options)
    content = sink.getvalue().to_pybytes()
    sha256 = hashlib.sha256(content).hexdigest()
    part = IndexPart(path=f"index/{sha256[:16]}.parquet", bytes=len(content), sha256=sha256)
    store.replace(part.path, content)
    return part


def changed(column, value):
    place = INDEX.get_field_index(column)
    return _ROWS.set_column(place, INDEX.field(place), [[value, *_ROWS[column].to_pylist()[1:]]])


INVALID = {
    "a path outside the dataset": (changed("path", "../a.txt"), "'../a.txt'"),
    "an absolute path": (changed("path", "/etc/passwd"), "'/etc/passwd'"),
    "an empty folder in a path": (changed("path", "a//a"), "'a//a'"),
    "a path with a line break": (changed("path", "a\n"), r"'a\\n'"),
    "a long path": (changed("path", "a/" * 250 + "a"), "plain names"),
    "a path twice": (_ROWS.take([0, 1, 1]), "repeated or unsorted"),
    "unsorted paths": (_ROWS.take([1, 0]), "repeated or unsorted"),
    "a negative size": (changed("bytes", -1), "got -1"),
    "a huge size": (changed("bytes", 2**40), "got 1099511627776"),
    "no hash": (changed("sha256", "0" * 63), "64 hexadecimal digits"),
    "another table": (_ROWS.replace_schema_metadata({"perilune.table": "frames"}), "perilune.schema_version"),
    "a missing column": (_ROWS.drop_columns(["bytes"]), "bytes"),
}


@pytest.mark.parametrize("name", INVALID)
def test_an_invalid_index_is_refused(name, tmp_path, info):
    rows, message = INVALID[name]
    store = open_store(tmp_path)
    part = written(store, rows)
    with pytest.raises(UserError, match=message) as raised:
        read_index(store, info.model_copy(update={"index": (part,)}))
    assert part.path in str(raised.value) and "\n" not in str(raised.value)


def test_a_huge_row_group_is_not_decompressed(tmp_path, info):
    """A dictionary would make 100,000 equal long paths a small file."""
    store = open_store(tmp_path)
    n = 100_000
    rows = pa.table([["a" * 400] * n, list(range(n)), [f"{k:064x}" for k in range(n)]], schema=INDEX)
    part = written(store, rows)
    with pytest.raises(UserError, match="in a row group"):
        read_index(store, info.model_copy(update={"index": (part,)}))


def damaged(how):
    def damage(path):
        content = path.read_bytes()
        path.unlink()
        if how == "truncated":
            path.write_bytes(content[:-1])
        elif how == "flipped":
            path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
        elif how == "a link":
            path.with_name("other").write_bytes(content)
            path.symlink_to("other")
        elif how == "a pipe":
            os.mkfifo(path)

    return damage


@pytest.mark.parametrize("how", ["missing", "truncated", "flipped", "a link", "a pipe"])
def test_a_damaged_index_is_refused(how, tmp_path, info):
    store = open_store(tmp_path)
    info = seal(store, info, _ROWS)
    path = tmp_path / info.index[0].path
    damaged(how)(path)
    with pytest.raises(UserError, match=str(path)):
        read_index(store, info)


def test_a_dataset_without_an_index_is_refused(tmp_path, info):
    with pytest.raises(UserError, match="index: got none"):
        read_index(open_store(tmp_path), info.model_copy(update={"index": ()}))


@pytest.mark.parametrize(
    "path", ["../index/0123456789abcdef.parquet", "manifest/frames/all.parquet", "index/a.parquet"]
)
def test_dataset_json_names_only_files_in_the_folder_of_the_index(path):
    with pytest.raises(ValueError, match="path"):
        IndexPart(path=path, bytes=1, sha256="0" * 64)


@pytest.mark.parametrize("address", ["local", "memory", "s3"])
def test_an_index_of_every_kind_of_store(address, request, tmp_path, info):
    if address == "s3":
        store = open_store(f"{request.getfixturevalue('s3_bucket')}/set")
    else:
        store = open_store(tmp_path / "set" if address == "local" else f"memory://{tmp_path.name}/set")
    assert read_index(store, seal(store, info, _ROWS)).equals(_ROWS)


def test_the_same_rows_give_the_same_index(tmp_path):
    first, second = open_store(tmp_path / "a"), open_store(tmp_path / "b")
    assert write_index(first, _ROWS) == write_index(second, _ROWS.take([1, 2, 0]))
