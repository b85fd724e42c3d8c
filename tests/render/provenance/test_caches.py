"""Where caches are kept, for a user without a home too."""

import os
import tempfile
from pathlib import Path

import pytest

from perilune_render.provenance import caches
from perilune_render.provenance.caches import cache_home, compiling, kept_fingerprint
from perilune_render.provenance.fingerprint import Fingerprint, fingerprint


@pytest.fixture
def homeless(tmp_path, monkeypatch):
    """The temporary folder of a user without a home."""

    def no_home():
        raise RuntimeError("no home")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_user_without_a_home_has_a_cache(homeless):
    folder = cache_home()
    assert folder.parent == homeless and folder.stat().st_mode & 0o777 == 0o700
    assert cache_home() == folder


def test_a_folder_that_others_may_write_is_not_taken(homeless):
    """numba executes what it reads."""
    theirs = cache_home()
    theirs.chmod(0o777)
    assert cache_home().parent == homeless and cache_home() != theirs
    theirs.rmdir()
    theirs.symlink_to(homeless)
    assert cache_home() != theirs


def test_a_home_that_is_no_folder_is_none(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "nonexistent"))
    assert cache_home().parent == tmp_path
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_home() == tmp_path / ".cache" / "perilune"


def test_only_an_absolute_xdg_folder_is_used(homeless, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(homeless / "xdg"))
    assert cache_home() == homeless / "xdg" / "perilune"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_home().parent == homeless


ROOT = "perilune_render.terrain.grid:graded_grid"


@pytest.fixture
def sources(tmp_path, monkeypatch):
    """A source file whose state the kept hashes follow; the number of computed hashes is the length of `computed`."""
    computed = []

    def counted(*roots):
        computed.append(roots)
        return fingerprint(*roots)

    source = tmp_path / "sources" / "module.py"
    source.parent.mkdir()
    source.write_text("VALUE = 1")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setattr(caches, "FOLDERS", {"package": source.parent})
    monkeypatch.setattr(caches, "fingerprint", counted)
    return source, computed


def test_a_hash_is_computed_once_and_kept(sources):
    _, computed = sources
    first, second = kept_fingerprint(ROOT), kept_fingerprint(ROOT)
    assert first == second == fingerprint(ROOT) and isinstance(second, Fingerprint) and len(computed) == 1
    other = "perilune_render.terrain.grid:"
    assert kept_fingerprint(other) == fingerprint(other) and len(computed) == 2
    assert kept_fingerprint(ROOT) == first and len(computed) == 2


def test_a_source_of_the_same_size_and_time_is_noticed(sources):
    source, computed = sources
    kept_fingerprint(ROOT)
    before = source.stat()
    source.write_text("VALUE = 2")
    os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert source.stat().st_size == before.st_size and source.stat().st_mtime_ns == before.st_mtime_ns
    kept_fingerprint(ROOT)
    assert len(computed) == 2


def test_without_a_folder_to_write_hashes_are_computed(sources, tmp_path):
    _, computed = sources
    (tmp_path / "kernels").write_text("a file")
    assert kept_fingerprint(ROOT) == kept_fingerprint(ROOT) == fingerprint(ROOT) and len(computed) == 2


def test_a_kernel_is_compiled_without_its_lock_if_it_cannot_be_had(tmp_path, monkeypatch):
    monkeypatch.setattr(caches, "_LONGEST_WAIT_S", 0.1)
    with compiling(tmp_path / "f.lock"), compiling(tmp_path / "f.lock"):
        pass
    with compiling(tmp_path / "absent" / "f.lock"):
        pass
