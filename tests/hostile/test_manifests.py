"""Datasets of very many files: missing ones, unknown ones, many frames. Memory and output stay bounded."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

import perilune_shared.editing.split
import perilune_shared.editing.subset
import perilune_shared.export.stats
import perilune_shared.validation.validate  # noqa: F401 (else imports count as memory)
from perilune_shared.cli.main import main as manifest
from perilune_shared.dataset.index import INDEX, index_rows, read_index, seal
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.schema import TABLES, complete
from perilune_shared.dataset.whole_tables import WholeTables
from perilune_shared.storage.items import Item
from perilune_shared.storage.store import LocalStore
from tests.helpers.drawn_dataset import build_dataset
from tests.hostile.measured import Outcome, accepted, outcome, refused

MILLION = 1_000_000
MANY_FRAMES = 200_000
_FRAMES_OF_TRAJECTORY = 1000


def words(output: str) -> str:
    """The output on one line: a title is wrapped where the path in it is long."""
    return " ".join(output.split())


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """A small dataset of two scenes."""
    splits = {"train": 1, "val": 1}
    return open_dataset(build_dataset(tmp_path / "data", "detect", side_px=32, splits=splits, n_frames=3, craters=30))


def faulty(name: str, folder: Path, memory_mb: float) -> Outcome:
    """Validate a dataset with very many faults: a short table that counts them."""
    ended = outcome(name, manifest, "validate", folder)
    assert ended.code == 2 and "Traceback" not in ended.output
    assert len(ended.output) < 300_000 and ended.memory_mb < memory_mb, ended.memory_mb
    return ended


@pytest.mark.parametrize("folder", ["frames/s000/t000/x", "unknown/x", "manifest/x"])
def test_a_million_unknown_files(folder: str, dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    true = LocalStore.list

    def with_more(store: LocalStore, prefix: str = "") -> Iterator[Item]:
        yield from true(store, prefix)
        if not prefix:
            yield from (Item(f"{folder}{number:07d}.png", 1) for number in range(MILLION))

    monkeypatch.setattr(LocalStore, "list", with_more)
    ended = faulty("a million unknown files", Path(str(dataset.store)), 50)
    assert ("1 fault" if folder.startswith("unknown") else f"{MILLION} faults") in words(ended.output)


def test_a_folder_of_many_names(dataset: Dataset) -> None:
    """The names of a folder are sorted in memory."""
    folder = Path(str(dataset.store)) / "frames/s000/t000"
    for number in range(50_000):
        (folder / f"x{number:06d}.png").touch()
    assert "50000 faults" in words(faulty("a folder of many names", Path(str(dataset.store)), 60).output)


def stated(dataset: Dataset, n_files: int) -> None:
    """Make the index name very many files that do not exist."""
    names = pc.binary_join_element_wise(
        "frames/x", pc.utf8_lpad(pa.array(np.arange(n_files)).cast(pa.string()), 7, "0"), ""
    )
    text = np.random.default_rng(0).bytes(32 * n_files).hex()
    hashes = pa.array([text[64 * number : 64 * number + 64] for number in range(n_files)])
    more = pa.table([names, pa.array(np.ones(n_files, np.int64)), hashes], schema=INDEX)
    seal(dataset.store, dataset.info, pa.concat_tables([read_index(dataset.store, dataset.info), more]))
    pa.default_memory_pool().release_unused()


def test_an_index_of_a_million_missing_files(dataset: Dataset, tmp_path: Path) -> None:
    stated(dataset, MILLION)
    ended = faulty("an index of a million files", Path(str(dataset.store)), 700)
    assert f"{2 * MILLION} faults" in words(ended.output)
    arguments = ("subset", dataset.store, "--out", tmp_path / "out")
    refused("a subset of a million files", manifest, *arguments, naming="no such file", memory_mb=700)


def many_frames(dataset: Dataset, n_frames: int) -> None:
    """Repeat the trajectories of the first scene, without labels and images."""
    tables = {name: complete(name, dataset.table(name)) for name in TABLES}
    writer = WholeTables(dataset.store, replace=True)
    for name in ("scenes", "craters"):
        writer.add(name, tables[name])
    trajectory, frame = (tables[name].slice(0, 1).to_pylist()[0] for name in ("trajectories", "frames"))
    unhashed = dict.fromkeys(("png_sha256", "png_bytes"))
    for place in range(n_frames // _FRAMES_OF_TRAJECTORY):
        key = {"trajectory_id": f"t{place:04d}"}
        new = trajectory | key | {"n_frames": _FRAMES_OF_TRAJECTORY, "seed": place}
        writer.add("trajectories", pa.Table.from_pylist([new], TABLES["trajectories"]))
        rows = pa.Table.from_pylist([frame | key | unhashed], TABLES["frames"]).take([0] * _FRAMES_OF_TRAJECTORY)
        ids = [f"{frame['scene_id']}/{key['trajectory_id']}/{index:06d}" for index in range(_FRAMES_OF_TRAJECTORY)]
        columns = {
            "frame_id": ids,
            "frame_index": range(_FRAMES_OF_TRAJECTORY),
            "position_m": list(np.arange(3.0 * _FRAMES_OF_TRAJECTORY).reshape(-1, 3) + 1e5 * place),
            "time_s": np.arange(float(_FRAMES_OF_TRAJECTORY)),
            "png_path": [f"frames/{name}.png" for name in ids],
        }
        for name, values in columns.items():
            field = rows.schema.field(name)
            rows = rows.set_column(rows.schema.get_field_index(name), field, pa.array(values, field.type))
        writer.add("frames", rows)
    parts = writer.finish()
    info = dataset.info.model_copy(update={"images": "absent", "counts": writer.counts})
    seal(dataset.store, info, index_rows(parts))
    # Else a command would find memory that this process has and does not use.
    pa.default_memory_pool().release_unused()


def test_many_frames(dataset: Dataset, tmp_path: Path) -> None:
    """Memory of each command is at most 2.5 kB for each frame."""
    many_frames(dataset, MANY_FRAMES)
    for command in ("stats", "split", "subset"):
        options = ["--out", tmp_path / command] if command != "stats" else []
        options += ["--by", "frame"] if command == "split" else []
        options += ["--where", "time_s < 10"] if command == "subset" else []
        accepted(f"{command} of many frames", manifest, command, dataset.store, *options, memory_mb=500)
    assert len(open_dataset(tmp_path / "subset")) == MANY_FRAMES // 100
