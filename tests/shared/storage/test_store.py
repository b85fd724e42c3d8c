"""The same calls on a local folder, in memory and on an S3 server."""

import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from perilune_shared.errors import UserError
from perilune_shared.storage.items import Item
from perilune_shared.storage.store import open_store


@pytest.fixture(params=["local", "memory", "s3"])
def address(request, tmp_path) -> str:
    if request.param == "s3":
        return f"{request.getfixturevalue('s3_bucket')}/moon"
    return str(tmp_path / "moon") if request.param == "local" else f"memory://{tmp_path.name}/moon"


@pytest.fixture
def store(address):
    return open_store(address)


def test_an_empty_store_lists_nothing(store):
    assert list(store.list()) == list(store.list("manifest")) == []
    assert store.size("dataset.json") is None and not store.exists("dataset.json")


def test_what_is_written_is_read_and_listed_in_order_of_paths(store):
    paths = ["a/b.txt", "a-b/c.txt", "a.txt", "frames/s/t/000000.png", "a/b/c.txt"]
    for n, path in enumerate(paths):
        store.write(path, b"x" * n)
    assert list(store.list()) == [Item(path, paths.index(path)) for path in sorted(paths)]
    assert [item.path for item in store.list("a")] == ["a/b.txt", "a/b/c.txt"]
    assert list(store.list("frames/s/t")) == [Item("frames/s/t/000000.png", 3)]
    assert store.size("frames/s/t/000000.png") == 3


def test_ranges(store):
    content = bytes(range(256)) * 40
    store.write("a.bin", content)
    assert store.read("a.bin") == content
    assert store.read("a.bin", 10, 20) == content[10:20] and store.read("a.bin", 10_000) == content[10_000:]
    assert store.read("a.bin", 5, 5) == b"" and store.read("a.bin", 0, 1) == content[:1]
    with store.open("a.bin") as stream:
        stream.seek(-4, os.SEEK_END)
        assert stream.read() == content[-4:] and stream.tell() == len(content)
        stream.seek(100)
        assert stream.read(3) == content[100:103]


def test_parquet_is_read_through_an_open_file(store):
    table = pa.table({"a": range(100_000)})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, row_group_size=10_000)
    store.write("a.parquet", sink.getvalue().to_pybytes())
    with store.open("a.parquet") as stream:
        assert pq.ParquetFile(stream).read_row_group(7)["a"][0].as_py() == 70_000


def test_a_file_is_written_once(store):
    store.write("a.txt", b"first")
    store.write("a.txt", b"first")
    for other in (b"other", b"first and more", b""):
        with pytest.raises(FileExistsError, match=r"a\.txt"):
            store.write("a.txt", other)
    assert store.read("a.txt") == b"first"
    store.replace("a.txt", b"second")
    assert store.read("a.txt") == b"second"


def test_one_of_several_writers_succeeds(store):
    def claim(n: int) -> bool:
        try:
            store.write("dataset.json", b"%d" % n)
        except FileExistsError:
            return False
        return True

    if store.is_local:
        pytest.skip("local folders have locks")
    with ThreadPoolExecutor(8) as pool:
        won = list(pool.map(claim, range(8)))
    assert sum(won) == 1 and store.read("dataset.json") == b"%d" % won.index(True)


def test_a_deleted_file_is_gone(store):
    store.write("a/b.txt", b"x")
    store.delete("a/b.txt")
    store.delete("a/b.txt")
    assert not store.exists("a/b.txt") and list(store.list()) == []


def test_a_store_below_a_prefix(store):
    store.sub("work/parts").write("a.txt", b"x")
    assert store.read("work/parts/a.txt") == b"x" and store.sub("work").sub("parts").size("a.txt") == 1
    assert store.sub("work").address == store.at("work")


@pytest.mark.parametrize("path", ["../a", "/a", "", "a/../../b", ".hidden", "a b", "a\n", "a\\b"])
def test_paths_that_are_not_plain_are_refused(path, store):
    calls = [store.size, store.plain_size, store.read, store.open, store.delete, store.sub]
    calls += [lambda path: store.write(path, b""), lambda path: store.replace(path, b"")]
    for call in calls:
        with pytest.raises(UserError, match="plain names"):
            call(path)


def test_a_missing_file_is_an_error_of_one_line(store):
    for call in (store.read, store.open, store.plain_size):
        with pytest.raises(UserError) as raised:
            call("a/b.txt")
        assert str(raised.value).startswith(f"{store.address}/a/b.txt: file: got no such file")


def test_a_store_travels_to_another_process(store):
    if store.address.startswith("memory"):
        pytest.skip("memory belongs to one process")
    store.write("a.txt", b"x")
    for method in ("fork", "spawn"):
        with multiprocessing.get_context(method).Pool(1) as pool:
            assert pool.apply(store.read, ("a.txt",)) == b"x"


def test_links_that_leave_the_folder_pipes_and_folders_are_refused(tmp_path):
    root = tmp_path / "set"
    root.mkdir()
    (tmp_path / "secret.txt").write_text("secret")
    (root / "out.txt").symlink_to(tmp_path / "secret.txt")
    (root / "up").symlink_to(tmp_path)
    os.mkfifo(root / "pipe")
    (root / "folder").mkdir()
    (root / "in.txt").symlink_to("real.txt")
    (root / "real.txt").write_text("real")
    store = open_store(root)
    for path in ("out.txt", "up/secret.txt", "pipe", "folder"):
        for call in (store.size, store.read, store.open, store.plain_size):
            with pytest.raises(UserError):
                call(path)
    for path in ("out.txt", "up/new.txt"):
        with pytest.raises(UserError, match="leave"):
            store.replace(path, b"x")
    assert store.read("in.txt") == b"real"
    with pytest.raises(UserError, match="link"):
        store.plain_size("in.txt")
    assert [item.path for item in store.list()] == ["in.txt", "out.txt", "pipe", "real.txt", "up"]


@pytest.mark.parametrize("address", ["ftp://host/a", "s3://", "s3://bucket/../a", "memory://a b", "s3://bucket/ a"])
def test_an_address_of_another_kind_is_refused(address):
    with pytest.raises(UserError, match="a path, s3://bucket/prefix"):
        open_store(address)


def test_a_missing_library_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(UserError, match=r"gs://bucket/a: address: .*perilune-shared\[gcs\]"):
        open_store("gs://bucket/a").size("a.txt")


def test_a_missing_bucket_is_an_error_of_one_line(s3_environment):
    store = open_store("s3://no-such-bucket/moon")
    for call in (lambda: list(store.list()), lambda: store.write("a.txt", b"x"), lambda: store.replace("a.txt", b"x")):
        with pytest.raises(UserError) as raised:
            call()
        assert "s3://no-such-bucket/moon" in str(raised.value) and "no such bucket" in str(raised.value)


_READ = """
import sys
from perilune_shared.console.command_line import run_command_line
from perilune_shared.storage.store import open_store
run_command_line(lambda: print(open_store(sys.argv[1]).read("a.txt")))
"""


@pytest.mark.parametrize(
    "change, expected",
    [
        ({"AWS_ACCESS_KEY_ID": "", "AWS_SECRET_ACCESS_KEY": ""}, "access: got NoCredentialsError"),
        (
            {"AWS_ENDPOINT_URL": "http://127.0.0.1:9", "AWS_MAX_ATTEMPTS": "2"},
            "connection: got EndpointConnectionError",
        ),
    ],
)
def test_faults_of_a_store_are_errors_of_one_line(change, expected, s3_bucket, tmp_path):
    environment = {**os.environ, "HOME": str(tmp_path), **change}
    environment = {name: value for name, value in environment.items() if value}
    done = subprocess.run([sys.executable, "-c", _READ, s3_bucket], capture_output=True, text=True, env=environment)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith(f"error: {s3_bucket}/a.txt: {expected}") and done.stderr.count("\n") == 1


def test_files_that_vanish_while_they_are_listed_are_left_out(tmp_path):
    store = open_store(tmp_path)
    for name in ("a", "b", "c/d", "e"):
        store.write(name, b"")
    listed = store.list()
    assert next(listed).path == "a"
    store.delete("b")
    store.delete_below("c")
    assert [item.path for item in listed] == ["e"]
