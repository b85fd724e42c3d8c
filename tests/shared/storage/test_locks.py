"""Locks of folders against other processes, killed processes and other machines."""

import fcntl
import json
import os
import signal
import subprocess
import sys
import threading

import pytest

from perilune_shared.errors import UserError
from perilune_shared.storage.files import new_folder, written_aside
from perilune_shared.storage.locks import LOCK_NAME, locked

HOLD = """
import sys, pathlib
from perilune_shared.storage.files import new_folder
from perilune_shared.storage.locks import locked
with {"locked": locked, "new_folder": new_folder}[sys.argv[1]](pathlib.Path(sys.argv[2])) as folder:
    if folder is not None:
        folder.joinpath("first").write_text("first")
    print("held", flush=True)
    sys.stdin.readline()
"""


def holder(way, folder):
    """Start another process that holds the lock of a folder until it reads a line."""
    command = [sys.executable, "-c", HOLD, way, str(folder)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    return process


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_second_process_is_refused_until_the_first_ends(tmp_path):
    process = holder("locked", tmp_path)
    before = names(tmp_path)
    try:
        with (
            pytest.raises(UserError, match=rf"locked by PID {process.pid} on host \S+ since 20\S+, ") as raised,
            locked(tmp_path),
        ):
            pytest.fail("locked twice")
        assert len(str(raised.value).splitlines()) == 1 and names(tmp_path) == before
    finally:
        process.communicate("\n")
    with locked(tmp_path):
        assert names(tmp_path) == [LOCK_NAME, f"{LOCK_NAME}.json"]
    assert names(tmp_path) == []


def test_a_killed_process_leaves_no_lock_and_no_temporary_file(tmp_path):
    process = holder("locked", tmp_path)
    (tmp_path / "frames").mkdir()
    left = [tmp_path / ".dataset.1.part.json", tmp_path / "frames/.000001.0123456789abcdef.part.png"]
    others = [tmp_path / ".hidden.json", tmp_path / "frames/000002.png", tmp_path / "my.part.png"]
    for path in left + others:
        path.write_text("")
    process.kill()
    process.wait()
    assert (tmp_path / LOCK_NAME).exists()
    with locked(tmp_path):
        assert not any(path.exists() for path in left) and all(path.exists() for path in others)
    assert names(tmp_path) == [".hidden.json", "frames", "my.part.png"]


def test_a_lock_of_another_machine_expires(tmp_path):
    record = tmp_path / f"{LOCK_NAME}.json"
    record.write_text(json.dumps({"pid": 1, "host": "other", "since": "2026-01-01", "boot_id": "other"}))
    with (
        pytest.raises(UserError, match=r"PID 1 on host other since 2026-01-01, .*remove .*\.json or wait"),
        locked(tmp_path),
    ):
        pytest.fail("locked twice")
    assert record.exists()
    os.utime(record, (0, 0))
    with locked(tmp_path):
        assert json.loads(record.read_text())["pid"] == os.getpid()


def test_threads_exclude_each_other(tmp_path):
    refused = []

    def second():
        try:
            with locked(tmp_path):
                pass
        except UserError as error:
            refused.append(error)

    with locked(tmp_path):
        thread = threading.Thread(target=second)
        thread.start()
        thread.join()
    assert len(refused) == 1


@pytest.mark.parametrize("way", [locked, new_folder])
def test_ctrl_c_while_the_lock_is_acquired_leaves_nothing(tmp_path, monkeypatch, way):
    acquire = fcntl.flock

    def acquire_and_interrupt(descriptor, operation):
        acquire(descriptor, operation)
        if operation & fcntl.LOCK_EX:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(fcntl, "flock", acquire_and_interrupt)
    with pytest.raises(KeyboardInterrupt), way(tmp_path / "out"):
        pytest.fail("not interrupted")
    assert names(tmp_path) == []


def test_a_refused_folder_is_not_left_behind(tmp_path):
    with pytest.raises(KeyError), locked(tmp_path / "new"):
        raise KeyError
    assert names(tmp_path) == []


def test_a_refused_new_folder_does_not_disturb_the_first(tmp_path):
    out = tmp_path / "out"
    process = holder("new_folder", out)
    with pytest.raises(UserError, match=f"locked by PID {process.pid} "), new_folder(out):
        pytest.fail("written twice")
    process.communicate("\n")
    with pytest.raises(UserError, match="a path that is not empty"), new_folder(out):
        pytest.fail("written twice")
    assert names(tmp_path) == ["out"] and (out / "first").read_text() == "first"


def test_a_folder_that_is_no_longer_empty_is_not_replaced(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(UserError, match="a path that is not empty"), new_folder(out) as folder:
        (folder / "mine").write_text("mine")
        out.mkdir()
        (out / "theirs").write_text("theirs")
    assert names(tmp_path) == ["out"] and names(out) == ["theirs"]


def test_temporary_folders_of_killed_writers_are_removed(tmp_path):
    for name in (".out.1.part", ".out.0123456789abcdef.part", ".out.2.1.part", ".other.1.part"):
        (tmp_path / name).mkdir()
    with new_folder(tmp_path / "out") as folder:
        (folder / "mine").write_text("mine")
    assert names(tmp_path) == [".other.1.part", ".out.2.1.part", "out"]


def test_temporary_names_of_one_process_differ(tmp_path):
    with written_aside(tmp_path / "a.png") as first, written_aside(tmp_path / "a.png") as second:
        assert first != second and first.suffix == second.suffix == ".png"
        first.write_bytes(b"1")
        second.write_bytes(b"2")
    assert names(tmp_path) == ["a.png"]
