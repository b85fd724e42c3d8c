"""Parquet tables from outside: the same columns as text, and what is refused before it is decompressed."""

import datetime
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from perilune_shared.errors import UserError
from perilune_shared.storage.tables import parquet
from perilune_shared.storage.tables.limits import TableLimits
from perilune_shared.storage.tables.read import open_table, read_table

LIMITS = TableLimits("measurements", 1_000_000, 10_000_000)


def _file(tmp_path, columns, **options):
    path = tmp_path / "table.parquet"
    metadata = options.pop("metadata", None)
    pq.write_table(pa.table(columns).replace_schema_metadata(metadata), path, **options)
    return path


@pytest.mark.parametrize("kind", [pa.float64(), pa.float32(), pa.int16(), pa.uint64(), pa.decimal128(9, 2)])
@pytest.mark.parametrize("options", [{}, {"use_dictionary": False}, {"row_group_size": 1}, {"compression": "zstd"}])
def test_numbers_of_every_type(tmp_path, kind, options):
    path = _file(tmp_path, {" a ": pa.array([1, None, 3], kind), "other": ["x", "y", "z"]}, **options)
    columns = read_table(path, LIMITS, {"a": "number"})
    assert np.array_equal(columns.numbers("a"), [1, np.nan, 3], equal_nan=True)
    assert columns.lines is None


@pytest.mark.parametrize(
    "kind", [pa.string(), pa.large_string(), pa.string_view(), pa.dictionary(pa.int8(), pa.string())], ids=str
)
@pytest.mark.parametrize("options", [{}, {"use_dictionary": False}, {"row_group_size": 2}])
def test_texts_of_every_type(tmp_path, kind, options):
    words = pa.array(["b", None, "a", "b", ""])
    path = _file(tmp_path, {"t": words.cast(kind)}, **options)
    texts = read_table(path, LIMITS, {"t": "text"}).texts("t")
    assert texts.to_list() == ["b", "", "a", "b", ""]
    assert sorted(texts.words) == ["a", "b"]


def test_integers_and_ids(tmp_path):
    path = _file(tmp_path, {"n": [1403715524907143168, 2], "id": [7, 8], "x": [1.0, 2.0]}, metadata={"frame": "site"})
    columns = read_table(path, LIMITS, {"n": "integer", "id": "text", "x": "integer", "absent": "text"}, ["n"])
    assert columns.integers("n").tolist() == [1403715524907143168, 2]
    assert columns.texts("id").to_list() == ["7", "8"]
    assert columns.integers("x").tolist() == [1, 2]
    assert "absent" not in columns
    with open_table(path, LIMITS) as table:
        assert table.names == ["n", "id", "x"]
        assert table.metadata == {"frame": "site"}


def test_many_rows_in_batches(tmp_path):
    n_rows = 2 * parquet._BATCH_ROWS + 5
    names = [f"n{n % 1000}" for n in range(n_rows)]
    path = _file(tmp_path, {"a": np.arange(n_rows) / 4, "t": names}, row_group_size=100_000)
    columns = read_table(path, LIMITS, {"a": "number", "t": "text"})
    assert np.array_equal(columns.numbers("a"), np.arange(n_rows) / 4)
    assert columns.texts("t").to_list() == names
    assert len(columns.texts("t").words) == 1000


@pytest.mark.parametrize(
    ("columns", "kind", "message"),
    [
        ({"b": [1]}, "number", "columns: got no a; columns b, expected a"),
        ({"a": ["x"]}, "number", "column a: got string, expected numbers"),
        ({"a": [[1, 2]]}, "number", "column a: got list<element: int64>, expected numbers"),
        ({"a": [True]}, "number", "column a: got bool, expected numbers"),
        ({"a": [datetime.datetime(2026, 1, 1)]}, "number", "column a: got timestamp[us], expected numbers"),
        (
            {"a": [1.5]},
            "integer",
            "column a: got Float value 1.500000 was truncated",
        ),
        ({"a": [1, None]}, "integer", "a: row 1: got nothing, expected an integer"),
        ({"a": [b"x"]}, "text", "column a: got binary, expected texts"),
        ({"a": [{"b": 1}]}, "text", "column a: got struct<b: int64>, expected texts"),
        ({"a": ["x" * 1001]}, "text", "column a: got a text of 1001 bytes, expected at most 1000"),
    ],
)
def test_another_column_is_refused(tmp_path, columns, kind, message):
    path = _file(tmp_path, columns)
    with pytest.raises(UserError, match=re.escape(f"{path}: {message}")):
        read_table(path, LIMITS, {"a": kind})


def test_a_damaged_file_is_refused(tmp_path):
    path = _file(tmp_path, {"a": np.arange(1000.0)})
    whole = path.read_bytes()
    for content in (b"PAR1", whole[:-1], whole[: len(whole) // 2] + b"PAR1", whole[:8] + bytes(3000) + whole[3008:]):
        path.write_bytes(content)
        with pytest.raises(UserError, match=re.escape(f"{path}: content: got ")):
            read_table(path, LIMITS, {"a": "number"})


def test_rows_and_texts_are_limited(tmp_path, monkeypatch):
    path = _file(tmp_path, {"a": np.zeros(300_000), "t": [f"{n:06}" for n in range(300_000)]})
    with pytest.raises(UserError, match="rows: got 300000 in a row group, expected at most 1000 for"):
        read_table(path, TableLimits("measurements", 1000, 10_000_000), {"a": "number"})
    with pytest.raises(UserError, match="size: got"):
        read_table(path, TableLimits("measurements", 1000, 1000), {"a": "number"})
    monkeypatch.setattr(parquet, "MAX_TEXT_CHARACTERS", 1_000_000)
    with pytest.raises(UserError, match="column t: got more than 1000000 characters in different values"):
        read_table(path, LIMITS, {"t": "text"})


def test_rows_without_bytes_are_refused(tmp_path):
    path = _file(tmp_path, {"a": np.zeros(900_000)})
    n_bytes = path.stat().st_size
    with pytest.raises(UserError, match=rf"expected at most 20\d+ for {n_bytes} bytes"):
        read_table(path, LIMITS, {"a": "number"})
