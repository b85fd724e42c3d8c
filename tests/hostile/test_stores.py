"""Object stores that lie: lists, sizes, keys outside the prefix, objects that change between two reads."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest

from perilune_shared.cli.main import main as manifest
from perilune_shared.storage.store import ObjectStore, open_store
from tests.helpers.drawn_dataset import build_dataset
from tests.hostile.measured import Outcome, accepted, outcome

System = Any
"""The file system of fsspec that a store uses."""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a small dataset, by relative path."""
    folder = tmp_path_factory.mktemp("data") / "data"
    build_dataset(folder, "detect", splits={"train": 1, "test": 1}, n_frames=2, side_px=48, craters=60)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def address(files: dict[str, bytes]) -> Iterator[str]:
    """The same dataset in a store in memory."""
    address = "memory://hostile0/data"
    store = open_store(address)
    fsspec.filesystem("memory").store.clear()
    for path, content in files.items():
        store.replace(path, content)
    yield address


class Liar:
    """A file system of fsspec with some of its methods replaced."""

    def __init__(self, changes: dict[str, Callable]):
        self._true, self._changes = fsspec.filesystem("memory"), changes

    def __getattr__(self, name: str) -> Any:
        change = self._changes.get(name)
        true = getattr(self._true, name)
        return true if change is None else lambda *given, **options: change(true, *given, **options)


def listed(change: Callable[[dict[str, Any]], object]) -> dict[str, Callable]:
    """A list of files, changed."""

    def find(true: Callable, *given: Any, **options: Any) -> dict[str, Any]:
        found = {key: dict(value) for key, value in true(*given, **options).items()}
        change(found)
        return found

    return {"find": find}


def added(key: str, size: object = 3) -> dict[str, Callable]:
    """A list with another key."""
    return listed(lambda found: found.update({key: {"name": key, "size": size, "type": "file"}}))


def sized(size: Callable[[str, int], object]) -> dict[str, Callable]:
    """Objects of another size than they have."""

    def info(true: Callable, path: str, **options: Any) -> dict[str, Any]:
        found = dict(true(path, **options))
        return found | {"size": size(path, found["size"])} if found["type"] == "file" else found

    return {"info": info}


def read(change: Callable[[str, bytes, int], bytes]) -> dict[str, Callable]:
    """Objects whose bytes change: `change` gets path, bytes, and the number of reads of this object before."""
    counts: dict[str, int] = {}

    def cat_file(true: Callable, path: str, **options: Any) -> bytes:
        counts[path] = counts.get(path, 0) + 1
        return change(path, true(path, **options), counts[path] - 1)

    return {"cat_file": cat_file}


def _flipped(content: bytes) -> bytes:
    return content[:-9] + bytes([content[-9] ^ 1]) + content[-8:] if len(content) > 9 else content


LIES = {
    "a key that climbs": added("/hostile0/data/manifest/frames/../../../secret.parquet"),
    "a key outside the prefix": added("/other/data/manifest/frames/s000.parquet"),
    "a key of an absolute path": added("/etc/passwd"),
    "a key that steers a terminal": added("/hostile0/data/manifest/frames/a\x1b[31m.parquet"),
    "a key of two lines": added("/hostile0/data/manifest/frames/a\nerror: spoofed.parquet"),
    "a key without a name": added(""),
    "a key of 10^6 letters": added("/hostile0/data/" + "x" * 1_000_000),
    "10^5 keys": listed(lambda found: found.update({f"/hostile0/data/x/{k:06d}": {"size": 1} for k in range(100_000)})),
    "a size that is not a number": listed(lambda found: [value.update(size=None) for value in found.values()]),
    "a size that is text": listed(lambda found: [value.update(size="a lot") for value in found.values()]),
    "a negative size": listed(lambda found: [value.update(size=-1) for value in found.values()]),
    "no size": listed(lambda found: [value.pop("size") for value in found.values()]),
    "an empty list": listed(lambda found: found.clear()),
    "objects larger than they say": sized(lambda path, size: size // 2),
    "objects smaller than they say": sized(lambda path, size: size + 1000),
    "objects of 2^60 bytes": sized(lambda path, size: 2**60),
    "objects of negative size": sized(lambda path, size: -5),
    "objects of unknown size": sized(lambda path, size: None),
    "objects that change after the first read": read(lambda path, content, n: content if n == 0 else _flipped(content)),
    "objects that shrink after the first read": read(lambda path, content, n: content if n == 0 else content[:-7]),
    "objects that grow": read(lambda path, content, n: content + b"x" * 1000),
    "objects that are endless": read(lambda path, content, n: content + bytes(300_000_000)),
    "empty answers": read(lambda path, content, n: b""),
    "answers of another kind": read(lambda path, content, n: None),  # type: ignore[arg-type, return-value]
}


def check(ended: Outcome) -> None:
    """Success, or one line and code 2; bounded memory; nothing that steers a terminal."""
    assert "Traceback" not in ended.output, ended.output[-2500:]
    assert ended.code == 0 or (ended.code == 2 and (ended.error or "fault" in ended.output)), ended.output[-2000:]
    assert all(sign.isprintable() or sign == "\n" for sign in ended.output), repr(ended.output[-2000:])
    assert not any(line.startswith("error: spoofed") for line in ended.output.splitlines())
    assert ended.memory_mb < 700, f"{ended.name}: {ended.memory_mb:.0f} MB"


@pytest.mark.parametrize("lie", LIES)
def test_a_store_that_lies(lie: str, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    liar = Liar({})
    monkeypatch.setattr(ObjectStore, "_system", property(lambda _: liar))
    liar._changes.update(LIES[lie])
    for name, command in (
        ("validate", ["validate", address]),
        ("stats", ["stats", address]),
        ("copy", ["subset", address, "--out", tmp_path / "copy", "--frames", "3"]),
        ("card", ["card", address, "--out", tmp_path / "card.md"]),
    ):
        ended = outcome(f"{lie}: {name}", manifest, *command)
        check(ended)
    # Nothing is written but what was asked for, inside the folder of the test.
    assert {path.name for path in tmp_path.iterdir()} <= {"copy", "card.md", "card.png"}
    if (tmp_path / "copy").exists():
        accepted(f"{lie}: the copy", manifest, "validate", tmp_path / "copy")
