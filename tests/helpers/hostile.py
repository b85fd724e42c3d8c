"""Hostile datasets: functions that damage a dataset, and the checks that it is refused."""

import hashlib
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from perilune_shared.cli.main import app
from perilune_shared.console.command_line import run_command_line
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.packed import SHARDS, packed_rows, shard_name
from perilune_shared.dataset.schema import TABLES, complete
from perilune_shared.errors import UserError
from perilune_shared.validation.validate import validate
from tests.helpers.drawn_dataset import seal

FaultPlaces = list[tuple[str, str]]
"""File and column of each fault; for an error message, the message twice."""
_GIB = 2**30


def part_of(root: Path, table: str) -> Path:
    """Return the only part of a table."""
    (path,) = (root / "manifest" / table).glob("*.parquet")
    return path


def rewrite(root: Path, table: str, change: Callable[[list[dict]], object]) -> None:
    """Apply `change` to the rows of a table."""
    path = part_of(root, table)
    rows = pq.read_table(path).to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, schema=TABLES[table]), path)


def put(table: str, column: str, value: object, row: int = 0) -> Callable[[Path], None]:
    """Replace one value."""
    return lambda root: rewrite(root, table, lambda rows: rows[row].__setitem__(column, value))


def edit(change: Callable[[dict], object]) -> Callable[[Path], None]:
    """Change dataset.json as plain data."""

    def damage(root: Path) -> None:
        path = root / "dataset.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return damage


def pack(root: Path, change: Callable[[list[dict]], object] = lambda rows: None, schema=SHARDS, **options) -> None:
    """Pack the frames in one shard for each split, with `change` applied to all rows."""
    frames, labels = (complete(name, pq.read_table(part_of(root, name))) for name in ("frames", "labels"))
    pngs = [(root / path).read_bytes() for path in frames["png_path"].to_pylist()]
    rows = packed_rows(frames, labels, pngs).to_pylist()
    splits = {row["frame_id"]: row["split"] for row in rows}
    change(rows)
    (root / "shards").mkdir()
    for split in sorted(set(splits.values())):
        own = [row for row in rows if splits.get(row["frame_id"], "train") == split]
        table = pa.Table.from_pylist(own, schema=schema)
        pq.write_table(table, root / shard_name(split, 0, 1), **{"use_dictionary": ["frame_id"], **options})
    edit(lambda content: content.update(images="packed"))(root)


def snapshot(folder: Path, excluded: Path) -> dict[str, tuple]:
    """Return content and times of all files in a folder, except the dataset `excluded`."""
    found = {}
    for path in [folder, *sorted(folder.rglob("*"))]:
        if path == folder or (path != excluded and excluded not in path.parents):
            state = path.lstat()
            content = path.read_bytes() if path.is_file() and not path.is_symlink() else None
            found[str(path)] = state.st_mode, state.st_mtime_ns if path != folder else 0, content
    return found


def read_all(dataset: Dataset) -> None:
    """Read everything that a reader can read."""
    for table in TABLES:
        dataset.table(table)
    for scene_id in dataset.scene_ids():
        dataset.scene(scene_id)
    for _ in dataset.pngs(dataset.table("frames", ["frame_id", "png_path"])):
        pass


def command(root: Path, name: str, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> str:
    """Run a command of `perilune-manifest` and return its output; fails unless errors are single lines."""
    monkeypatch.setattr(sys, "argv", ["perilune-manifest", name, str(root)])
    monkeypatch.setenv("COLUMNS", "1500")
    capsys.readouterr()
    code = 0
    try:
        run_command_line(app)
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    assert code in (0, 2), (code, out, err)
    output = out + err
    assert "Traceback" not in output and "Warning" not in output
    # The progress bar is printed before the error.
    lines = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(lines) == (code == 2 and " fault" not in out), output
    assert not lines or err.rstrip().endswith(lines[0]), err
    assert name != "validate" or code == 2, output
    assert all(c.isprintable() or c == "\n" for c in output), repr(output)
    return output


def faults_in_output(printed: str) -> FaultPlaces:
    """Parse the output of `validate`: file and column of each fault, or the error message."""
    rows = [[cell.strip() for cell in line.split("│")] for line in printed.splitlines() if line.startswith("│")]
    assert all(len(row) == 7 and row[4] and row[5] for row in rows), printed
    refused = [line for line in printed.splitlines() if line.startswith("error: ")]
    return [(row[1], row[3]) for row in rows] + [(line, line) for line in refused]


def faults_or_error(root: Path) -> FaultPlaces:
    """Open and validate a dataset; return its faults, or the message of the UserError. Other errors propagate."""
    try:
        faults = validate(open_dataset(root))
    except UserError as error:
        assert "\n" not in str(error) and len(str(error)) < 6000
        return [(str(error), str(error))]
    assert all(len(text) <= 300 for fault in faults for text in (fault.file, fault.column, fault.found, fault.expected))
    return [(fault.file, fault.column) for fault in faults]


def assert_refused(root: Path, file: str, column: str, capsys, monkeypatch) -> None:
    """Check that library and command line refuse a dataset and name file and column, and change nothing beside it."""
    before = snapshot(root.parent, root)
    faults = faults_in_output(command(root, "validate", capsys, monkeypatch))
    assert any(file in found and column in name for found, name in faults), faults
    try:
        read_all(open_dataset(root))
    except UserError as error:
        assert "\n" not in str(error)
    command(root, "stats", capsys, monkeypatch)
    assert snapshot(root.parent, root) == before


_CHILD = """
import resource, sys, time
from pathlib import Path
from tests.helpers.hostile import faults_or_error
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
faults = faults_or_error(Path(sys.argv[1]))
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print((after - before) // 1024, faults)
"""


def faults_within_limits(root: Path, most_mib: int, most_s: int = 30) -> str:
    """Run `faults_or_error` in a new process with limits on time and on memory beyond its libraries."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (6 * _GIB, 6 * _GIB))
        resource.setrlimit(resource.RLIMIT_CPU, (most_s, most_s))

    run = subprocess.run(
        [sys.executable, "-c", _CHILD, str(root)],
        capture_output=True,
        text=True,
        timeout=4 * most_s,
        preexec_fn=limit,
        cwd=Path(__file__).parents[2],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert run.returncode == 0, run.stderr
    mib, _, faults = run.stdout.partition(" ")
    assert int(mib) <= most_mib, run.stdout
    return faults


def digest(content: bytes) -> str:
    """Return the SHA-256, hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def sealed(damage: Callable[[Path], object]) -> Callable[[Path], None]:
    """Apply a damage, then write a valid index."""

    def both(root: Path) -> None:
        damage(root)
        seal(root)

    return both
