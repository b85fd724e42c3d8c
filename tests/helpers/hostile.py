"""Datasets of ill will: how to damage one, and what must come of it."""

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

from perilune_shared.cli import main as cli
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.schema import IMAGES, TABLES
from perilune_shared.errors import UserError, run_command_line
from perilune_shared.storage import checksums
from perilune_shared.validation.validate import validate

Told = list[tuple[str, str]]
"""File and column of each fault; of a refusal by one line, the line twice."""
_GIB = 2**30


def part_of(root: Path, table: str) -> Path:
    """The only part of a table."""
    (path,) = (root / "manifest" / table).glob("*.parquet")
    return path


def rewrite(root: Path, table: str, change: Callable[[list[dict]], object]) -> None:
    """Apply `change` to a table's rows."""
    path = part_of(root, table)
    rows = pq.read_table(path).to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, schema=TABLES[table]), path)


def put(table: str, column: str, value: object, row: int = 0) -> Callable[[Path], None]:
    """One value replaced."""
    return lambda root: rewrite(root, table, lambda rows: rows[row].__setitem__(column, value))


def edit(change: Callable[[dict], object]) -> Callable[[Path], None]:
    """dataset.json changed as plain data."""

    def damage(root: Path) -> None:
        path = root / "dataset.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return damage


def pack(root: Path, change: Callable[[list[dict]], object] = lambda rows: None, schema=IMAGES, **options) -> None:
    """The frames in one shard instead of files, with `change` applied to its rows."""
    frames = pq.read_table(part_of(root, "frames")).to_pylist()
    rows = [
        {
            "frame_id": row["frame_id"],
            "image": {"bytes": (root / row["png_path"]).read_bytes(), "path": row["png_path"]},
        }
        for row in frames
    ]
    change(rows)
    (root / "images").mkdir()
    table = pa.Table.from_pylist(rows, schema=schema)
    pq.write_table(table, root / "images/00000.parquet", **{"use_dictionary": ["frame_id"], **options})
    edit(lambda content: content.update(images="packed"))(root)


def snapshot(folder: Path, but: Path) -> dict[str, tuple]:
    """All that lies in a folder beside a dataset, with its content and times."""
    found = {}
    for path in [folder, *sorted(folder.rglob("*"))]:
        if path == folder or (path != but and but not in path.parents):
            state = path.lstat()
            content = path.read_bytes() if path.is_file() and not path.is_symlink() else None
            found[str(path)] = state.st_mode, state.st_mtime_ns if path != folder else 0, content
    return found


def read_all(dataset: Dataset) -> None:
    """Whatever a reader reads."""
    for table in TABLES:
        dataset.table(table)
    for scene_id in dataset.scene_ids():
        dataset.scene(scene_id)
    for _ in dataset.pngs(dataset.table("frames", ["frame_id", "png_path"])):
        pass


def command(root: Path, name: str, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> str:
    """Run `perilune-manifest`; what it printed, once it is known that it ended as a user's fault should."""
    monkeypatch.setattr(sys, "argv", ["perilune-manifest", name, str(root)])
    monkeypatch.setenv("COLUMNS", "1500")
    capsys.readouterr()
    code = 0
    try:
        run_command_line(cli.app)
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    assert code in (0, 2), (code, out, err)
    told = out + err
    assert "Traceback" not in told and "Warning" not in told
    # The progress bar comes before it.
    lines = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(lines) == (code == 2 and " fault" not in out), told
    assert not lines or err.rstrip().endswith(lines[0]), err
    assert name != "validate" or code == 2, told
    assert all(c.isprintable() or c == "\n" for c in told), repr(told)
    return told


def told_by(printed: str) -> Told:
    """File and column of each fault in the table that `validate` printed, or the line with which it refused."""
    rows = [[cell.strip() for cell in line.split("│")] for line in printed.splitlines() if line.startswith("│")]
    assert all(len(row) == 7 and row[4] and row[5] for row in rows), printed
    refused = [line for line in printed.splitlines() if line.startswith("error: ")]
    return [(row[1], row[3]) for row in rows] + [(line, line) for line in refused]


def told_of(root: Path) -> Told:
    """What opening and validating tells of a dataset. Fails where it raises anything but a user's fault."""
    try:
        faults = validate(open_dataset(root))
    except UserError as error:
        assert "\n" not in str(error) and len(str(error)) < 6000
        return [(str(error), str(error))]
    assert all(len(text) <= 300 for fault in faults for text in (fault.file, fault.column, fault.found, fault.expected))
    return [(fault.file, fault.column) for fault in faults]


def assert_refused(root: Path, file: str, column: str, capsys, monkeypatch) -> None:
    """A damaged dataset is refused, naming file and column, by library and command line; nothing beside it changes."""
    before = snapshot(root.parent, root)
    told = told_by(command(root, "validate", capsys, monkeypatch))
    assert any(file in found and column in name for found, name in told), told
    try:
        read_all(open_dataset(root))
    except UserError as error:
        assert "\n" not in str(error)
    command(root, "stats", capsys, monkeypatch)
    assert snapshot(root.parent, root) == before


_CHILD = """
import resource, sys, time
from pathlib import Path
from tests.helpers.hostile import told_of
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
told = told_of(Path(sys.argv[1]))
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print((after - before) // 1024, told)
"""


def told_within(root: Path, most_mib: int, most_s: int = 30) -> str:
    """What a process of its own tells of a dataset, which has that much memory beyond its libraries, and that time."""

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
    mib, _, told = run.stdout.partition(" ")
    assert int(mib) <= most_mib, run.stdout
    return told


def digest(content: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def sealed(damage: Callable[[Path], object]) -> Callable[[Path], None]:
    """A damage whose doer also made the checksums anew."""

    def both(root: Path) -> None:
        damage(root)
        checksums.seal(root)

    return both
