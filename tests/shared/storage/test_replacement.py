from pathlib import Path

import pytest

from perilune_shared.errors import UserError
from perilune_shared.storage import replacement
from perilune_shared.storage.replacement import replaceable


def write(out: Path, content: str) -> None:
    out.mkdir()
    (out / "table").write_text(content)


def content_of(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


def test_an_older_folder_is_replaced_whole(tmp_path):
    write(tmp_path / "out", "old")
    (tmp_path / "out" / "more").write_text("old")
    with replaceable(tmp_path / "out", ("table",), overwrite=True) as folder:
        write(folder, "new")
        assert (tmp_path / "out" / "table").read_text() == "old"
    assert content_of(tmp_path) == {"out/table": "new"}


def test_an_older_folder_is_replaced_whole_without_an_exchange(tmp_path, monkeypatch):
    """As on systems that cannot exchange two folders."""
    monkeypatch.setattr(replacement, "_exchanged", lambda *_: False)
    write(tmp_path / "out", "old")
    with replaceable(tmp_path / "out", ("table",), overwrite=True) as folder:
        write(folder, "new")
    assert content_of(tmp_path) == {"out/table": "new"}

    def fail(path: Path, target: Path) -> Path:
        if path.suffix == ".new":
            raise OSError
        return rename(path, target)

    rename = Path.rename
    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(OSError), replaceable(tmp_path / "out", ("table",), overwrite=True) as folder:
        write(folder, "newer")
    assert content_of(tmp_path) == {"out/table": "new"}


def test_what_a_killed_command_left_is_removed(tmp_path):
    for name in ("out", ".out.0123456789abcdef.new", ".out.0123456789abcdef.old", ".out.new", ".other.01.new"):
        write(tmp_path / name, name)
    with replaceable(tmp_path / "out", ("table",), overwrite=True) as folder:
        write(folder, "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".other.01.new", ".out.new", "out"]


def test_two_commands_at_once_do_not_replace_one_folder(tmp_path):
    write(tmp_path / "out", "old")
    with replaceable(tmp_path / "out", ("table",), overwrite=True) as folder:
        write(folder, "new")
        with (
            pytest.raises(UserError, match="locked by"),
            replaceable(tmp_path / "out", ("table",), overwrite=True),
        ):
            pytest.fail("not refused")
    assert content_of(tmp_path) == {"out/table": "new"}


def test_the_older_folder_stays_after_a_failure(tmp_path):
    write(tmp_path / "out", "old")
    with pytest.raises(ZeroDivisionError), replaceable(str(tmp_path / "out"), ("table",), overwrite=True) as folder:
        write(Path(folder), "new")
        raise ZeroDivisionError
    assert content_of(tmp_path) == {"out/table": "old"}


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_new_folder_is_written_in_its_place(tmp_path, overwrite):
    with replaceable(tmp_path / "out", ("table",), overwrite=overwrite) as folder:
        assert folder == tmp_path / "out"


def test_no_other_folder_is_deleted(tmp_path, monkeypatch):
    write(tmp_path / "out", "old")
    for out, known_by, message in (
        (str(tmp_path / "out"), ("picture",), "got another folder, expected a folder that this command wrote"),
        (str(tmp_path / "out"), ("table", "*.png"), r"wrote, with table and \*.png"),
        ("s3://bucket/prefix", ("table",), "got an address"),
        (str(tmp_path / "out"), ("table",), "got the current folder"),
    ):
        if "current" in message:
            monkeypatch.chdir(tmp_path / "out")
        with pytest.raises(UserError, match=message), replaceable(out, known_by, overwrite=True):
            pytest.fail("not refused")
    assert content_of(tmp_path) == {"out/table": "old"}


@pytest.mark.parametrize("read", ["out", "out/table", "link"])
def test_no_folder_that_is_read_is_deleted(tmp_path, read):
    write(tmp_path / "out", "old")
    (tmp_path / "link").symlink_to(tmp_path / "out")
    inputs = ("memory://dataset", str(tmp_path / read))
    with (
        pytest.raises(UserError, match="got a folder that contains the input"),
        replaceable(tmp_path / "out", ("table",), overwrite=True, inputs=inputs),
    ):
        pytest.fail("not refused")
    assert content_of(tmp_path / "out") == {"table": "old"}
