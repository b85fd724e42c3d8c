"""A command that adds files to a dataset may be killed at any write: nothing is lost, and the next command cures it."""

import shutil
from pathlib import Path

import pytest
from rich.progress import Progress

from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.editing.subset import subset
from perilune_shared.export.card import write_card
from perilune_shared.export.croissant import export_croissant
from perilune_shared.storage import files
from perilune_shared.storage.store import LocalStore
from perilune_shared.validation.files import EXTRA_NAMES
from perilune_shared.validation.validate import validate


class Killed(BaseException):
    """The process is gone."""


class DyingStore(LocalStore):
    """A folder whose writer is killed at the n-th write or deletion, before, within or after it."""

    def __init__(self, folder: Path, n: int, when: str):
        super().__init__(folder)
        self.left, self.when = n, when

    def replace(self, path: str, content: bytes) -> None:
        self._last_words(path, content, lambda: super(DyingStore, self).replace(path, content))

    def delete(self, path: str) -> None:
        self._last_words(path, b"", lambda: super(DyingStore, self).delete(path))

    def _last_words(self, path, content, act):
        self.left -= 1
        if self.left > 0:
            return act()
        if self.left == 0 and self.when == "within":
            files.temporary_name(self.folder / path).write_bytes(content[: len(content) // 2])
        if self.left == 0 and self.when == "after":
            act()
        raise Killed


def card(dataset):
    with Progress(disable=True) as progress:
        write_card(dataset, None, progress)


COMMANDS = {"card": card, "croissant": export_croissant}


def killed(command, root, n, when):
    """Run a command that is killed at its n-th write; return whether it was."""
    dataset = open_dataset(root)
    try:
        command(Dataset(DyingStore(root, n, when), dataset.info))
    except Killed:
        return True
    return False


@pytest.fixture(scope="module")
def states(little, tmp_path_factory):
    """A dataset without added files, and one with files of an earlier run that differ from those of the next."""
    bare = Path(shutil.copytree(little, tmp_path_factory.mktemp("states") / "bare"))
    full = Path(shutil.copytree(bare, bare.with_name("full")))
    (full / "README.md").write_text("<!-- written by `perilune-manifest card` -->\nold\n")
    (full / "card.png").write_bytes(b"old")
    (full / "croissant.json").write_bytes(b"{}")
    export_croissant(open_dataset(full), full / "croissant.json")
    (full / "LICENSE").write_text("text")
    (full / "croissant.json").write_bytes(b"{}")
    export_croissant(open_dataset(full))
    assert validate(open_dataset(full)) == []
    return {"bare": bare, "full": full}


@pytest.mark.parametrize(
    "when", ["within", *(pytest.param(when, marks=pytest.mark.slow) for when in ("before", "after"))]
)
@pytest.mark.parametrize("state", ["bare", pytest.param("full", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_is_completed_by_the_next_one(name, state, when, states, tmp_path, monkeypatch):
    monkeypatch.setattr("perilune_shared.export.card.draw", lambda dataset, gathered: b"picture")
    n, was_killed = 0, True
    while was_killed:
        n += 1
        root = Path(shutil.copytree(states[state], tmp_path / f"{n}"))
        was_killed = killed(COMMANDS[name], root, n, when)
        for fault in validate(open_dataset(root)):
            # No fault of content: only files that are not in the index, with the cure.
            assert fault.column == "file" and "perilune-manifest card" in fault.expected, fault
            assert fault.file in EXTRA_NAMES or fault.file.startswith(("index/", ".")), fault
        if n == 3 and when == "before":
            subset(open_dataset(root), tmp_path / "copy", images="none")  # reading and copying still work
        for cure in COMMANDS if n % 2 else reversed(COMMANDS):
            again = Path(shutil.copytree(root, tmp_path / f"{n}-{cure}"))
            COMMANDS[cure](open_dataset(again))
            assert validate(open_dataset(again)) == []
    assert n > 3
