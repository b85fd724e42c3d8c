"""Tables of text as people have them, and what is refused with file, line, column and value."""

import re

import numpy as np
import pytest

from perilune_shared.errors import UserError
from perilune_shared.storage.tables import text as text_module
from perilune_shared.storage.tables.limits import MAX_LINE_BYTES, TableLimits
from perilune_shared.storage.tables.read import open_table, read_table

LIMITS = TableLimits("measurements", 1000, 10_000_000)
NUMBERS = {"a": "number", "b": "number"}

SAME = {
    "plain": "a,b\n1,2\n3,4\n",
    "no line break at the end": "a,b\n1,2\n3,4",
    "byte order mark": "\ufeffa,b\n1,2\n3,4\n",
    "Windows": "a,b\r\n1,2\r\n3,4\r\n",
    "old Macintosh": "a,b\r1,2\r3,4\r",
    "semicolons": "a;b\n1;2\n3;4\n",
    "tabs": "a\tb\n1\t2\n3\t4\n",
    "spaces between": "a b\n1   2\n  3 4\n",
    "spaces around": " a , b \n 1 , 2 \n 3 , 4 \n",
    "separator at the end": "a,b,\n1,2,\n3,4,\n",
    "separator at the end of the rows": "a,b\n1,2,\n3,4,,\n",
    "comments": "# made by hand\n\n# twice\na,b\n1,2\n# a remark\n3,4\n# end\n",
    "header in a comment": "# remark, of no use, at all\n#a, b\n1,2\n3,4\n",
    "empty lines and rows": "a,b\n\n1,2\n,\n   \n3,4\n,,\n",
    "quotes": '"a","b"\n"1","2"\n"3", "4"\n',
    "other order, other columns": 'name,b,a\n"Tycho, wall",2,1\n"two\nlines",4,3\n',
    "Latin-1 in another column": "name,a,b\nB\udcfcrg,1,2\nCauchy,3,4\n",
    "exponents": "a,b\n1e0,+2.\n3.0E+00,.4e1\n",
}


def _file(tmp_path, content, name="table.csv"):
    path = tmp_path / name
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    return path


@pytest.mark.parametrize("name", SAME)
def test_every_form_of_a_table_gives_the_same_numbers(tmp_path, name):
    columns = read_table(_file(tmp_path, SAME[name]), LIMITS, NUMBERS)
    assert columns.n_rows == 2
    assert columns.numbers("a").tolist() == [1, 3]
    assert columns.numbers("b").tolist() == [2, 4]


def test_a_table_without_rows_has_its_names(tmp_path):
    for content in ("a,b\n", "# a, b\n"):
        columns = read_table(_file(tmp_path, content), LIMITS, NUMBERS)
        assert columns.n_rows == 0
        assert columns.numbers("a").shape == (0,)


def test_kinds_of_columns(tmp_path):
    content = "id,time,name,x\n1,1403715524907143168,north,1\n2,-5,,\n3,6.0,north,nan\n"
    columns = read_table(_file(tmp_path, content), LIMITS, {"time": "integer", "name": "text", "x": "number"})
    assert columns.integers("time").tolist() == [1403715524907143168, -5, 6]
    assert columns.texts("name").words == ["north"]
    assert columns.texts("name").codes.tolist() == [0, -1, 0]
    assert columns.texts("name").to_list() == ["north", "", "north"]
    assert np.isnan(columns.numbers("x")).tolist() == [False, True, True]
    assert columns.lines.tolist() == [2, 3, 4]


def test_names_of_a_file_without_header(tmp_path):
    path = _file(tmp_path, "# x y\n1 2\n3 4\n", "poses.TUM")
    with open_table(path, LIMITS, header=("a", "b")) as table:
        assert table.comments == ["x y"]
        assert table.read(NUMBERS).numbers("b").tolist() == [2, 4]


REFUSED = {
    "a,b\n1,2\n3,x\n": "{path}:3: b: got x, expected a number",
    "a;b\n1;2,5\n": "{path}:2: b: got 2,5, expected a number with a decimal point",
    "a,b\n1,1_000\n": "{path}:2: b: got 1_000, expected a number",
    "# note\na,b\n\n1,2,3\n": "{path}:4: values: got 3, expected 2, one for each column",
    "a,b\n1\n": "{path}:2: values: got 1, expected 2, one for each column",
    "x,y\n1,2\n": "{path}: columns: got no a, b; columns x, y, expected a, b",
    "a,b,a\n1,2,3\n": "{path}: columns: got 2 times a, expected a once",
    "1,2\n3,4\n": "{path}:1: header: got 1, 2, expected names of columns in the first row",
    "": "{path}: columns: got no a, b; columns none, expected a, b",
    "a,b\n1,\0\n": "{path}:2: text: got a zero byte, expected a text file with measurements",
    'a,b\n1,"2\n' + "3,4\n" * 40_000: "{path}:2: row: got more than 65536 bytes, expected a row of a table; "
    "a closing quote may be missing",
    "a,b\n1," + "2" * 70_000: "{path}:2: line: got more than 65536 bytes, expected a row of a table",
    "a,b\n" + "1,2\n" * 1001: "{path}: rows: got more than 1000, expected at most 1000 rows of measurements",
    ",".join(f"n{n}" for n in range(1001)): "{path}:1: columns: got 1001, expected at most 1000",
    "\ufeff<!DOCTYPE html>": "{path}: format: got HTML or XML, expected a CSV or Parquet file with measurements",
    "\x1f\udc8b,": "{path}: format: got a gzip file; unpack it, expected a CSV or Parquet file with measurements",
}


@pytest.mark.parametrize("content", REFUSED, ids=lambda content: REFUSED[content][:40])
def test_a_wrong_table_is_refused_in_one_line(tmp_path, content):
    path = _file(tmp_path, content)
    with pytest.raises(UserError) as caught:
        read_table(path, LIMITS, NUMBERS)
    assert str(caught.value) == REFUSED[content].format(path=path)


def test_values_of_other_kinds_are_refused(tmp_path):
    path = _file(tmp_path, "n,t\n1,x\n2.5,y\n")
    with pytest.raises(UserError, match=re.escape(f"{path}:3: n: got 2.5, expected an integer")):
        read_table(path, LIMITS, {"n": "integer"})
    path = _file(tmp_path, f"n,t\n99999999999999999999,{'x' * 1001}\n")
    with pytest.raises(UserError, match="n: got 99999999999999999999, expected an integer"):
        read_table(path, LIMITS, {"n": "integer"})
    with pytest.raises(UserError, match="t: got 1001 characters, expected at most 1000"):
        read_table(path, LIMITS, {"t": "text"})
    path = _file(tmp_path, "t\nB\udcfcrg\n")
    with pytest.raises(UserError, match=r"t: got 'B\\udcfcrg', expected text in UTF-8"):
        read_table(path, LIMITS, {"t": "text"})


def test_all_texts_of_a_column_together_are_limited(tmp_path, monkeypatch):
    monkeypatch.setattr(text_module, "MAX_TEXT_CHARACTERS", 100)
    path = _file(tmp_path, "t\n" + "".join(f"{n:010}\n" for n in range(11)))
    with pytest.raises(UserError, match=r"table.csv:12: t: got more than 100 characters"):
        read_table(path, LIMITS, {"t": "text"})


def test_no_file_a_folder_and_a_large_file(tmp_path):
    with pytest.raises(UserError, match="file: got no such file, expected a CSV or Parquet file with measurements"):
        read_table(tmp_path / "none.csv", LIMITS, NUMBERS)
    with pytest.raises(UserError, match="file: got a folder"):
        read_table(tmp_path, LIMITS, NUMBERS)
    path = tmp_path / "large.csv"
    with path.open("wb") as stream:
        stream.truncate(10_000_001)
    with pytest.raises(UserError, match="size: got 10000001 bytes, expected at most 10000000"):
        read_table(path, LIMITS, NUMBERS)


def test_checks_name_file_line_column_and_value(tmp_path):
    path = _file(tmp_path, "# a comment\na,b\n1,2\n,4\n200,inf\n")
    columns = read_table(path, LIMITS, NUMBERS)
    with pytest.raises(UserError, match=re.escape(f"{path}:4: a: got nothing, expected a number from 0 to 100")):
        columns.finite("a", 0, 100)
    with pytest.raises(UserError, match=re.escape(f"{path}:5: b: got inf, expected a finite number")):
        columns.finite("b")


def test_a_large_table_is_read_in_batches(tmp_path):
    n_rows = 2 * text_module._BATCH_ROWS + 7
    path = _file(tmp_path, "a,b\n" + "".join(f"{n},{n / 4}\n" for n in range(n_rows)))
    columns = read_table(path, TableLimits("measurements", n_rows, 10**8), NUMBERS)
    assert np.array_equal(columns.numbers("b"), np.arange(n_rows) / 4)
    assert np.array_equal(columns.lines, np.arange(n_rows) + 2)


def test_a_line_at_the_limit_is_read(tmp_path):
    name = "x" * (MAX_LINE_BYTES - 5)
    assert read_table(_file(tmp_path, f"a,b,{name}\n1,2,3\n"), LIMITS, NUMBERS).numbers("b").tolist() == [2]
