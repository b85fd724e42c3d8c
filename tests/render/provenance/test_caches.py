"""Where caches are kept, for a user without a home too."""

import tempfile
from pathlib import Path

import pytest

from perilune_render.provenance.caches import cache_home


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
