import os
from pathlib import Path

import pytest

from perilune_shared.errors import UserError
from perilune_shared.storage import files


def test_a_file_is_written_completely_or_not_at_all(tmp_path):
    target = tmp_path / "folder" / "a.txt"
    with pytest.raises(RuntimeError), files.written_aside(target) as aside:
        aside.write_text("half")
        raise RuntimeError
    assert not target.exists() and list(target.parent.iterdir()) == []
    files.write_text(target, "whole")
    assert target.read_text() == "whole" and len(list(target.parent.iterdir())) == 1


@pytest.mark.parametrize(
    "path", ["/etc/passwd", "../x.png", "a/../../x", "", "a\\b", "a/./../b", ".hidden", "a//../b", "a b", "-rf", "a\n"]
)
def test_paths_that_could_leave_the_folder_are_refused(tmp_path, path):
    with pytest.raises(UserError):
        files.inside(tmp_path, path)


def test_a_link_that_leaves_the_folder_is_refused(tmp_path):
    root = tmp_path / "dataset"
    root.mkdir()
    (root / "out").symlink_to(tmp_path)
    with pytest.raises(UserError):
        files.inside(root, "out/secret.png")


def test_a_plain_path_is_returned(tmp_path):
    assert files.inside(tmp_path, "frames/scene-0000/000001.png") == tmp_path / "frames/scene-0000/000001.png"


def test_sha256_of_abc(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert files.sha256_of(tmp_path / "a") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_a_file_is_synchronised_before_the_rename(tmp_path, monkeypatch):
    """Otherwise a power failure after the rename could leave an empty file that looks complete."""
    synchronised = []

    def fsync(descriptor):
        synchronised.append(Path(f"/proc/self/fd/{descriptor}").resolve())
        assert (tmp_path / "a.txt").exists() == (len(synchronised) > 1)

    monkeypatch.setattr(os, "fsync", fsync)
    files.write_text(tmp_path / "a.txt", "whole")
    assert len(synchronised) == 2 and ".part" in synchronised[0].name and synchronised[1] == tmp_path
    files.write_bytes(tmp_path / "b.png", b"frame", durable=False)
    assert len(synchronised) == 2
