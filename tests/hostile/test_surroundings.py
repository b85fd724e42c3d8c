"""Commands with few file descriptors, without a home or temporary folder, and with a clock that jumps.

Each does its work, or ends with one line and exit code 2.
"""

import resource

import pytest

from tests.hostile.commands import USES, Use
from tests.hostile.place import Place

COMMANDS = (
    "perilune-render dataset",
    "perilune-render serve",
    "perilune-render preview",
    "perilune-manifest validate",
    "perilune-manifest pack",
    "perilune-train detect train",
    "perilune-train detect evaluate",
    "perilune-train detect deploy",
    "perilune-train navigate methods",
    "perilune-train report",
)
SURROUNDINGS: dict[str, dict[str, str | None]] = {
    "64 file descriptors": {},
    "no HOME": {"HOME": None},
    "a HOME that does not exist": {"HOME": "/proc/nowhere"},
    "a HOME that is a file": {"HOME": "/dev/null"},
    "no TMPDIR": {"TMPDIR": None},
    "a TMPDIR that does not exist": {"TMPDIR": "/proc/nowhere"},
    "a clock that jumps": {"PERILUNE_CLOCK": "1"},
}


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Place:
    made = Place(tmp_path_factory.mktemp("surroundings"))
    done = made.run(next(one for one in USES if one.command == "perilune-render dataset"))
    assert done.returncode == 0, done.stderr
    return made


def few_descriptors() -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))


@pytest.mark.parametrize("surroundings", SURROUNDINGS)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_works_or_ends_with_one_line(place, command, surroundings):
    usual = next(one for one in USES if one.command == command)
    # Results of their own; what the commands read is of the first surroundings, or they refuse it.
    renamed = surroundings.replace(" ", "-")
    words = [f"{word}-{renamed}" if before in ("--out", "--name") else word for before, word in _pairs(usual.arguments)]
    preexec = few_descriptors if surroundings == "64 file descriptors" else None
    done = place.run(Use(command, tuple(words), usual.code), (), SURROUNDINGS[surroundings], preexec)
    text = done.stdout + done.stderr
    assert "Traceback" not in text and "Exception ignored" not in text, text[-4000:]
    assert done.returncode in (usual.code, 2), f"{done.returncode}\n{text[-3000:]}"
    if done.returncode == 2:
        errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
        assert len(errors) == 1, text[-3000:]


def _pairs(words: tuple[str, ...]) -> list[tuple[str, str]]:
    return list(zip(("", *words), words, strict=False))
