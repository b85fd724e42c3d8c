"""Tables `inertial` and `ranges` follow their trajectories through every edit, and `validate` checks them."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from tests.helpers.drawn_dataset import build_dataset, seal

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.parts import write_part
from perilune_shared.dataset.schema import OPTIONAL_TABLES
from perilune_shared.editing.diff import differences
from perilune_shared.editing.merge import merge
from perilune_shared.editing.pack import pack, unpack
from perilune_shared.editing.subset import subset
from perilune_shared.export.croissant import metadata_of
from perilune_shared.validation.validate import validate


@pytest.fixture(scope="module")
def nav(tmp_path_factory):
    root = build_dataset(
        tmp_path_factory.mktemp("nav") / "nav", "nav", splits={"train": 2, "val": 1, "test": 1}, scenes=2
    )
    return open_dataset(root)


def test_the_drawn_dataset_is_valid(nav):
    assert validate(nav) == []
    assert nav.info.counts.inertial == len(nav.table("inertial")) > 100


def test_a_subset_keeps_the_measurements_of_its_trajectories(nav, tmp_path):
    subset(nav, tmp_path / "some", ["trajectory_id == 't001'"])
    made = open_dataset(tmp_path / "some")
    assert validate(made) == []
    for name in OPTIONAL_TABLES:
        own = nav.table(name, scene_id="s001", trajectory_id="t001")
        assert len(own) and made.table(name) == own


def test_merged_halves_give_the_dataset_back(nav, tmp_path):
    halves = []
    for number, condition in enumerate(("frame_index < 4", "frame_index >= 4")):
        subset(nav, tmp_path / str(number), [condition])
        halves.append(open_dataset(tmp_path / str(number)))
    merge(halves, tmp_path / "whole")
    made = open_dataset(tmp_path / "whole")
    assert validate(made) == []
    assert {each.table for each in differences(nav, made)} <= {"dataset.json", "trajectories", "frames"}
    assert made.info.counts.inertial == nav.info.counts.inertial


def test_a_renamed_trajectory_takes_its_measurements_along(nav, tmp_path):
    other = open_dataset(build_dataset(tmp_path / "other", "nav", splits={"train": 1, "val": 1, "test": 1}, seed=8))
    merge([nav, other], tmp_path / "both")
    made = open_dataset(tmp_path / "both")
    assert validate(made) == []
    assert made.info.counts.ranges == nav.info.counts.ranges + other.info.counts.ranges


def test_packing_and_unpacking_keep_them(nav, tmp_path):
    pack(nav, tmp_path / "packed")
    unpack(open_dataset(tmp_path / "packed"), tmp_path / "files")
    made = open_dataset(tmp_path / "files")
    assert {each.table for each in differences(nav, made)} <= {"dataset.json"}
    assert made.info.counts.inertial == nav.info.counts.inertial


def test_a_plan_has_none(nav, tmp_path):
    subset(nav, tmp_path / "plan", images="plan")
    made = open_dataset(tmp_path / "plan")
    assert validate(made) == [] and not made.parts("inertial") and not made.info.counts.ranges


def test_datasets_without_them_have_no_parts(tmp_path):
    detect = open_dataset(build_dataset(tmp_path / "detect", "detect"))
    assert validate(detect) == [] and len(detect.table("inertial")) == 0 and not detect.parts("inertial")
    assert not {each["@id"] for each in metadata_of(detect)["recordSet"]} & set(OPTIONAL_TABLES)


def test_croissant_describes_them(nav):
    assert set(OPTIONAL_TABLES) <= {each["@id"] for each in metadata_of(nav)["recordSet"]}


def _without_a_row(rows):
    return pa.concat_tables([rows[:5], rows[6:]])


def _set(name, values):
    return lambda rows: rows.set_column(rows.schema.get_field_index(name), rows.schema.field(name), values(rows))


FAULTS = [
    ("inertial", _without_a_row, "interval_s", "without a gap"),
    ("inertial", lambda rows: rows.take(pa.array([1, 0, *range(2, len(rows))])), "time_s", "increasing times"),
    ("ranges", _set("time_s", lambda rows: pc.add(rows["time_s"], 1000.0)), "time_s", "the duration of"),
    ("ranges", _set("range_m", lambda rows: pa.array(np.full(len(rows), -1.0))), "range_m", "above 0"),
    ("inertial", _set("trajectory_id", lambda rows: pa.array(["t999"] * len(rows))), "scene_id", "the rows of the"),
]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return build_dataset(tmp_path_factory.mktemp("built") / "nav", "nav")


@pytest.mark.parametrize(("table", "change", "column", "expected"), FAULTS)
def test_a_wrong_measurement_is_found(table, change, column, expected, built, tmp_path):
    root = Path(shutil.copytree(built, tmp_path / "nav"))
    rows = change(open_dataset(root).table(table))
    write_part(root, table, "all", rows.cast(rows.schema), replace=True)
    info = (root / "dataset.json").read_text()
    counted = f'"{table}": {len(open_dataset(root).table(table))}'
    (root / "dataset.json").write_text(_with_count(info, table, counted))
    seal(root)
    found = [fault for fault in validate(open_dataset(root)) if fault.column == column]
    assert found and expected in found[0].expected and table in found[0].file


def _with_count(info, table, counted):
    before, _, after = info.partition(f'"{table}": ')
    return before + counted + after[len(after) - len(after.lstrip("0123456789")) :]
