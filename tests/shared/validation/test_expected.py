"""Unexpected files in a dataset's folder are faults; each file is hashed once in a run."""

import shutil

import pyarrow.parquet as pq
import pytest
from rich.progress import Progress
from tests.helpers.drawn_dataset import seal
from tests.helpers.hostile import edit, part_of

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.merge import merge
from perilune_shared.editing.pack import pack
from perilune_shared.errors import UserError
from perilune_shared.export.card import write_card
from perilune_shared.export.croissant import export_croissant
from perilune_shared.storage.locks import locked
from perilune_shared.storage.store import LocalStore
from perilune_shared.validation.validate import validate

UNEXPECTED = {
    "a part in a subfolder": ("manifest/labels/train/all.parquet", "manifest/labels/train"),
    "a hidden part": ("manifest/labels/.all.parquet", None),
    "a table of another name": ("manifest/extra/all.parquet", "manifest/extra"),
    "a file among the tables": ("manifest/README.md", None),
    "a part of another suffix": ("manifest/frames/all.csv", None),
    "shards of a dataset that is not packed": ("shards/train-00000-of-00001.parquet", "shards"),
    "a Parquet file beside dataset.json": ("train.parquet", None),
    "a program": ("perilune.py", None),
    "a hidden file": (".hidden", None),
    "a folder": ("data/train/a.png", "data"),
    "a frame that no row names": ("frames/s000/t000/000009.png", None),
    "a file among the frames": ("frames/metadata.jsonl", None),
    "a temporary file": (".dataset.0123456789abcdef.part.json", None),
}


@pytest.mark.parametrize("name", UNEXPECTED)
@pytest.mark.parametrize("indexed", [False, True])
def test_unexpected_files_are_faults_even_in_the_index(name, indexed, victim):
    path, reported = UNEXPECTED[name]
    (victim / path).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(part_of(victim, "labels"), victim / path)
    if indexed:
        seal(victim)
    faults = [(fault.file, fault.column) for fault in validate(open_dataset(victim))]
    assert ((path, "file") in faults) or (reported or path, "file") in faults


def test_a_frame_row_does_not_make_a_table_expected(victim):
    """The path of the frame is in the folder of another table."""
    path = "manifest/labels/other.parquet.png"
    part = part_of(victim, "frames")
    rows = pq.read_table(part)
    (victim / rows["png_path"][0].as_py()).rename(victim / path)
    place = rows.schema.get_field_index("png_path")
    cells = [path, *rows["png_path"].to_pylist()[1:]]
    pq.write_table(rows.set_column(place, rows.schema.field(place), [cells]), part)
    seal(victim)
    assert (path, "file") in [(fault.file, fault.column) for fault in validate(open_dataset(victim))]


def test_a_broken_link_is_a_fault(victim):
    """Also with a progress bar, which needs file sizes."""
    link = victim / "manifest/labels/other.parquet"
    link.write_bytes(b"")
    seal(victim)
    link.unlink()
    link.symlink_to("nowhere")
    with Progress(disable=True) as progress:
        faults = validate(open_dataset(victim), progress)
    assert {("manifest/labels/other.parquet", "SHA-256"), ("manifest/labels/other.parquet", "part")} <= {
        (fault.file, fault.column) for fault in faults
    }


def test_known_files_and_the_lock_of_a_writer_are_expected(victim):
    for name in ("LICENSE", "CITATION.cff"):
        (victim / name).write_text("text")
    assert [fault.file for fault in validate(open_dataset(victim))] == ["CITATION.cff", "LICENSE"]  # not in the index
    seal(victim)
    with locked(victim):
        assert validate(open_dataset(victim)) == []
    edit(lambda content: content.update(complete=False))(victim)
    (victim / ".dataset.0123456789abcdef.part.json").touch()
    seal(victim)
    assert [fault.column for fault in validate(open_dataset(victim))] == ["complete"]


def test_cards_and_metadata_have_fixed_names_in_a_dataset(crowded, tmp_path):
    root = shutil.copytree(crowded, tmp_path / "set")
    dataset = open_dataset(root)
    with Progress(disable=True) as progress:
        write_card(dataset, None, progress)
        export_croissant(dataset, None, progress)
        assert validate(open_dataset(root)) == []
        for work in (
            lambda: write_card(dataset, root / "a.md", progress),
            lambda: export_croissant(dataset, root / "a.json"),
        ):
            with pytest.raises(UserError, match="--out"):
                work()
    assert validate(open_dataset(root)) == []


def test_each_file_is_hashed_once(crowded_packed, tmp_path, monkeypatch):
    root = shutil.copytree(crowded_packed, tmp_path / "set")
    read, whole = [], LocalStore.sha256

    def counted(store, path, *rest):
        if store.folder == root:
            read.append(path)
        return whole(store, path, *rest)

    monkeypatch.setattr(LocalStore, "sha256", counted)
    large = {path.relative_to(root).as_posix() for path in root.rglob("*.parquet") if path.parent.name != "index"}
    with Progress(disable=True) as progress:
        for work in (
            lambda: write_card(open_dataset(root), None, progress),
            lambda: export_croissant(open_dataset(root), None, progress),
            lambda: merge([open_dataset(root)] * 2, tmp_path / "m", progress=progress),
            lambda: pack(open_dataset(root), tmp_path / "p", progress=progress),
        ):
            read.clear()
            work()
            own = [name for name in read if name in large]
            assert sorted(own) == sorted(large)
        assert {task.description for task in progress.tasks} >= {"hashing"}
        assert all(
            task.fields["unit"] == "MB" and task.finished for task in progress.tasks if task.description == "hashing"
        )
    assert validate(open_dataset(root)) == []
