"""Very many files that are missing or unknown: the list of faults is bounded, and each kind of fault is in it."""

import shutil

import pyarrow as pa
import pytest
from tests.helpers.hostile import command

from perilune_shared.dataset import index
from perilune_shared.dataset.index import index_rows, read_index, seal
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.parts import WrittenFile
from perilune_shared.editing.subset import subset
from perilune_shared.errors import UserError
from perilune_shared.validation.validate import validate

_MANY = 1500


def test_unknown_files_are_counted(victim, capsys, monkeypatch):
    for number in range(_MANY):
        (victim / f"frames/s000/t000/x{number:04d}.png").touch()
    faults = validate(open_dataset(victim))
    assert len(faults) == 1001 and sum(one.n_faults for one in faults) == _MANY
    assert faults[-1].found == "500 more faults"
    printed = command(victim, "validate", capsys, monkeypatch)
    assert "1500 faults" in printed and "the first 50" in printed and printed.count("x0") == 50


def test_missing_files_are_counted(victim):
    dataset = open_dataset(victim)
    absent = index_rows(WrittenFile(f"manifest/labels/s{number:04d}.parquet", 1, "0" * 64) for number in range(_MANY))
    rows = read_index(dataset.store, dataset.info)
    seal(dataset.store, dataset.info, pa.concat_tables([rows, absent]))
    faults = validate(open_dataset(victim))
    assert {one.column for one in faults} == {"SHA-256", "file"}
    assert sum(one.n_faults for one in faults) == 2 * _MANY and len(faults) == 2002


def test_many_unknown_files_do_not_hide_an_unknown_part(victim, tmp_path):
    """A part that no index names is read by its place; an edit would give it a hash."""
    for number in range(_MANY):
        (victim / f"a{number:04d}").touch()
    shutil.copy(victim / "manifest/labels/all.parquet", victim / "manifest/labels/all.0001.parquet")
    with pytest.raises(UserError, match=r"all\.0001.*not in the index"):
        subset(open_dataset(victim), tmp_path / "out")
    assert "manifest/labels/all.0001.parquet" in [one.file for one in validate(open_dataset(victim))]


def test_an_index_has_a_maximum_of_all_rows(victim, monkeypatch):
    monkeypatch.setattr(index, "MAX_TOTAL_ROWS", 5)
    dataset = open_dataset(victim)
    with pytest.raises(UserError, match="rows: got more than 5"):
        read_index(dataset.store, dataset.info)
    rows = index_rows(WrittenFile(f"frames/{number}.png", 1, "0" * 64) for number in range(6))
    with pytest.raises(UserError, match="pack the frames"):
        seal(dataset.store, dataset.info, rows)
