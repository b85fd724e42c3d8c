"""Conditions: types are checked, no code is executed, row groups are skipped."""

import math

import numpy as np
import pyarrow as pa
import pytest

from perilune_shared.dataset.expression import Condition
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.parts import Part
from perilune_shared.errors import UserError

ROWS = pa.table(
    {
        "labels.radius_px": [1.0, 5.0, 9.0, math.nan],
        "labels.contrast": [1.0, None, 9.0, 4.0],
        "frames.split": ["train", "test", "val", "test"],
        "frames.frame_index": [0, 1, 7, -8],
        "frames.position_m": pa.FixedSizeListArray.from_arrays(pa.array(np.arange(12.0)), 3),
    }
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("radius_px > 4", [0, 1, 1, 0]),
        ("4 < radius_px <= 9", [0, 1, 1, 0]),
        ("not radius_px > 4", [1, 0, 0, 1]),
        ("split == 'test'", [0, 1, 0, 1]),
        ("split in ('val', 'test') and radius_px < 6", [0, 1, 0, 0]),
        ("split not in ['val'] or radius_px == 9", [1, 1, 1, 1]),
        ("position_m[2] > 5 and position_m[0] < 9", [0, 0, 1, 0]),
        ("sqrt(labels.radius_px) * 2 - 1 >= 3.4", [0, 1, 1, 0]),
        ("abs(-radius_px) % 4 == 1", [1, 1, 1, 0]),
        ("frame_index % 3 == 1", [0, 1, 1, 1]),
        ("frame_index % -3 == -2", [0, 1, 1, 1]),
        ("frame_index / 2 == 0.5", [0, 1, 0, 0]),
        ("frame_index in (1.0, 7)", [0, 1, 1, 0]),
        ("radius_px in (1, 9)", [1, 0, 1, 0]),
        ("split < 'train' and True", [0, 1, 0, 1]),
        ("contrast > 2", [0, 0, 1, 1]),
        ("not contrast > 2", [1, 0, 0, 0]),
        ("contrast != 9", [1, 0, 0, 1]),
    ],
)
def test_conditions(text, expected):
    assert Condition(text).holds(ROWS).astype(int).tolist() == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("radius > 4", "radius_px"),
        ("boulders.diameter_m > 1", "table.column"),
        ("labels.diameter_m > 1", "table.column"),
        ("__import__('os').system('touch x')", "columns"),
        ("radius_px.__class__", "table.column"),
        ("(lambda: radius_px)()", "columns"),
        ("[x for x in radius_px]", "columns"),
        ("f'{radius_px}' == '1'", "columns"),
        ("radius_px if split == 'a' else 1", "columns"),
        ("radius_px", "true or false"),
        ("radius_px > 'a'", "numbers with numbers"),
        ("radius_px == '5'", "numbers with numbers"),
        ("radius_px == True", "numbers with numbers"),
        ("radius_px == None", "columns"),
        ("split != 5", "text with text"),
        ("split in ('val', 5)", "numbers with numbers"),
        ("radius_px in ('5', '6')", "numbers with numbers"),
        ("split in 'value'", "a list after"),
        ("split in (split, 'test')", "a list of"),
        ("radius_px in ()", "a list after"),
        ("split > 1", "numbers with numbers"),
        ("split + 'a' == 'vala'", "a number"),
        ("split * 999 == 'a'", "a number"),
        ("position_m > 1", "numbers with numbers"),
        ("position_m[7] > 1", "element 0 to 2"),
        ("position_m[-1] > 1", "columns"),
        ("radius_px[0] > 1", "columns"),
        ("abs(radius_px, evil=3) > 1", "one positional argument of abs"),
        ("abs(evil=radius_px) > 1", "one positional argument of abs"),
        ("sqrt(radius_px, 2) > 1", "one positional argument of sqrt"),
        ("sqrt(*position_m) > 1", "columns"),
        ("sqrt(split) > 1", "a number"),
        ("exec(radius_px) > 1", "columns"),
        ("radius_px.abs(1) > 1", "columns"),
        ("radius_px and split == 'test'", "conditions"),
        ("not radius_px", "conditions"),
        ("radius_px is 5", "one of =="),
        ("1 < 2", "on columns"),
        ("radius_px >", "a condition such as"),
        ("radius_px := 3", "a condition such as"),
        ("radius_px ** 9999 > 1", "columns"),
        ("frame_index > 99999999999999999999", "a condition such as"),
        ("(" * 500 + "radius_px" + ")" * 500, "a condition such as"),
        ("not " * 490 + "radius_px > 1", "a condition such as"),
        ("radius_px > 1 or " * 200 + "radius_px > 1", "a condition such as"),
        ("", "a condition such as"),
    ],
)
def test_invalid_conditions_are_refused(text, message):
    with pytest.raises(UserError, match=message) as raised:
        Condition(text)
    assert str(raised.value).startswith("--where: got ") and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "text", ["frame_index * 9223372036854775807 > 1", "frame_index % (frame_index - frame_index) == 1"]
)
def test_arithmetic_overflow_is_an_error(text):
    with pytest.raises(UserError, match="range"):
        Condition(text).holds(ROWS)


@pytest.mark.parametrize(
    ("text", "held"),
    [
        ("contrast in (1, 2)", [True, False, False]),
        ("contrast not in (1, 2)", [False, False, True]),
        ("not contrast in (1.5,)", [True, False, True]),
        ("contrast != 1", [False, False, True]),
        ("photometry not in ('a', 'b')", [False, False, True]),
    ],
)
def test_null_is_neither_in_nor_not_in_a_list(text, held):
    rows = pa.table({"labels.contrast": [1.0, None, 3.0], "scenes.photometry": ["a", None, "c"]})
    assert Condition(text).holds(rows).tolist() == held


def test_conditions_skip_row_groups(crowded_packed):
    """Row groups whose statistics exclude the condition are not read; the result equals filtering all rows."""
    dataset = open_dataset(crowded_packed)
    condition = Condition("split == 'val' or frame_id < 's000/t000/000002'")
    frames = dataset.table("frames").to_pandas()
    expected = frames[(frames["split"] == "val") | (frames["frame_id"] < "s000/t000/000002")]["frame_id"].tolist()
    assert dataset.table("frames", ["frame_id"], where=condition)["frame_id"].to_pylist() == expected
    (path,) = dataset.parts("craters")
    part = Part(dataset.store, path, "craters")
    assert part.n_groups > 1
    few = part.groups_where(Condition("craters.scene_id == 's002'").within_table())
    assert 0 < len(few) < part.n_groups
    assert part.groups_where(Condition("craters.diameter_m < 0").within_table()) == []
    assert dataset.table("craters", where=Condition("craters.scene_id == 's002'")).equals(
        dataset.table("craters", scene_id="s002")
    )
    with pytest.raises(UserError, match="only on columns of craters"):
        dataset.table("craters", where=Condition("radius_px > 1"))
