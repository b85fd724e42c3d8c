"""Read text tables: one row per line, with values separated by commas, semicolons, tabs or spaces.

Accepts the output of spreadsheets and other programs: a byte order mark, CRLF, spaces around names and values, a
separator at the end of each line, empty lines, and comments (`#`) anywhere. If the first row contains only numbers, and
the last comment before it contains as many names, this comment is the header, as in files of EuRoC.
"""

import csv
import io
import itertools
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.storage.tables.columns import Columns, Kind, Texts, check_present, check_unique
from perilune_shared.storage.tables.limits import (
    MAX_COLUMNS,
    MAX_LINE_BYTES,
    MAX_TEXT_CHARACTERS,
    MAX_VALUE_CHARACTERS,
    TableLimits,
)

_BATCH_ROWS, _BATCH_CHARACTERS = 20_000, 2_000_000
_MAX_COMMENTS = 1_000
_MIN_INTEGER, _MAX_INTEGER = -(2**63), 2**63 - 1
Row = tuple[int, list[str]]
"""Line number from 1, and the values of a row."""


class TextTable:
    """An open text table whose header has been read."""

    def __init__(self, path: Path, limits: TableLimits, header: Sequence[str] | None = None):
        """Open a file. `header` gives the column names of a file without a header."""
        self.path, self._limits = path, limits
        self.comments: list[str] = []
        """At most 1000 comment lines before the first row, without `#`."""
        self.metadata: dict[str, str] = {}
        """Always empty; a ParquetTable has the schema's metadata here."""
        self._stream: TextIO = path.open(encoding="utf-8-sig", errors="surrogateescape", newline=None)
        try:
            self._lines = self._read_lines()
            first = next(self._lines, None)
            self.separator = _separator(first[1]) if first else ","
            self._rows = self._split(itertools.chain([first] if first else [], self._lines))
            self.names = list(header) if header is not None else self._header()
        except BaseException:
            self._stream.close()
            raise

    def __enter__(self) -> "TextTable":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stream.close()

    def peek(self) -> Row | None:
        """Return the next row without consuming it; None at the end."""
        first = next(self._rows, None)
        if first is not None:
            self._rows = itertools.chain([first], self._rows)
        return first

    def rows(self) -> Iterator[Row]:
        """Yield the remaining rows, each with one value per column.

        Raises UserError if a row has another number of values, and if there are more rows than the limit.
        """
        n_names = len(self.names)
        for n_rows, (line, words) in enumerate(self._rows, 1):
            if len(words) > n_names:
                words = _without_empty_end(words, n_names)
            if len(words) != n_names:
                raise UserError(f"{self.path}:{line}", "values", len(words), f"{n_names}, one for each column")
            if n_rows > self._limits.rows:
                raise UserError(
                    self.path,
                    "rows",
                    f"more than {self._limits.rows}",
                    f"at most {self._limits.rows} rows of {self._limits.kind}",
                )
            yield line, words

    def read(self, columns: Mapping[str, Kind], required: Sequence[str] = ()) -> Columns:
        """Read the given columns; columns that the table lacks are omitted.

        Raises UserError on an invalid value.
        """
        check_present(self.path, self.names, required)
        wanted = [name for name in columns if name in self.names]
        check_unique(self.path, self.names, wanted)
        positions = [self.names.index(name) for name in wanted]
        built = [_builder(columns[name], self.path, name) for name in wanted]
        lines = array("q")
        rows = self.rows()
        while batch := _batch(rows):
            numbers = [line for line, _ in batch]
            for position, column in zip(positions, built, strict=True):
                column.add([words[position] for _, words in batch], numbers)
            lines.extend(numbers)
        arrays = {name: column.array() for name, column in zip(wanted, built, strict=True)}
        return Columns(
            self.path, arrays, len(lines), np.frombuffer(lines, np.int64) if lines else np.zeros(0, np.int64)
        )

    def _read_lines(self) -> Iterator[tuple[int, str]]:
        """Yield number and text of each line that is neither empty nor a comment."""
        n_seen = 0
        for line in itertools.count(1):
            text = self._stream.readline(MAX_LINE_BYTES + 1)
            if not text:
                return
            if len(text) > MAX_LINE_BYTES:
                raise UserError(f"{self.path}:{line}", "line", f"more than {MAX_LINE_BYTES} bytes", "a row of a table")
            if "\0" in text:
                raise UserError(f"{self.path}:{line}", "text", "a zero byte", f"a text file with {self._limits.kind}")
            stripped = text.strip()
            if stripped.startswith("#"):
                if not n_seen and len(self.comments) < _MAX_COMMENTS:
                    self.comments.append(stripped[1:].strip())
            elif stripped:
                n_seen += 1
                yield line, text

    def _split(self, lines: Iterator[tuple[int, str]]) -> Iterator[Row]:
        """Yield the stripped values of each row; rows without any value are omitted."""
        if self.separator == " ":
            yield from ((line, text.split()) for line, text in lines)
            return
        counted = _Counted(self.path, lines)
        reader = csv.reader(counted, delimiter=self.separator, skipinitialspace=True)
        try:
            for values in reader:
                # Strip only lines that contain a space, since stripping takes most of the time.
                words = [value.strip() for value in values] if counted.has_space else values
                if words[0] or any(words):
                    yield counted.first_line, words
                counted.begin_row()
        except csv.Error as error:
            raise UserError(f"{self.path}:{counted.line}", "row", error, "values with separators") from None

    def _header(self) -> list[str]:
        """Read the column names."""
        first = next(self._rows, None)
        if first is None:
            return self._names_in_comment(0) or []
        line, words = first
        if all(_is_number(word) for word in words if word):
            words_of_row = _without_empty_end(words, 0)
            names = self._names_in_comment(len(words_of_row))
            if names is None:
                found = ", ".join(words[:8])
                raise UserError(f"{self.path}:{line}", "header", found, "names of columns in the first row")
            self._rows = itertools.chain([first], self._rows)
            return names
        names = _without_empty_end(words, 0)
        if len(names) > MAX_COLUMNS:
            raise UserError(f"{self.path}:{line}", "columns", len(names), f"at most {MAX_COLUMNS}")
        return names

    def _names_in_comment(self, n_columns: int) -> list[str] | None:
        """Return the names in the last comment if their number is `n_columns`, or None.

        With `n_columns` 0, returns the names if there are at least two.
        """
        for comment in reversed(self.comments[-1:]):
            names = (
                comment.split() if self.separator == " " else [word.strip() for word in comment.split(self.separator)]
            )
            names = _without_empty_end(names, 0)
            if len(names) == n_columns or (n_columns == 0 and 1 < len(names) <= MAX_COLUMNS):
                return names
        return None


class _Counted:
    """Lines for csv.reader; records the line where the current row begins, and limits the row's length."""

    def __init__(self, path: Path, lines: Iterator[tuple[int, str]]):
        self._path, self._lines, self._length = path, lines, 0
        self.first_line = self.line = 0
        self.has_space = False

    def __iter__(self) -> "_Counted":
        return self

    def __next__(self) -> str:
        self.line, text = next(self._lines)
        self.first_line = self.first_line or self.line
        self._length += len(text)
        self.has_space = self.has_space or " " in text or "\t" in text or not text.isascii()
        if self._length > MAX_LINE_BYTES:
            expected = "a row of a table; a closing quote may be missing"
            raise UserError(f"{self._path}:{self.first_line}", "row", f"more than {MAX_LINE_BYTES} bytes", expected)
        return text

    def begin_row(self) -> None:
        """Start a row at the next line."""
        self.first_line = self._length = 0
        self.has_space = False


class _Numbers:
    """Builds a column of numbers."""

    def __init__(self, path: Path, name: str):
        self._path, self._name, self._parts = path, name, [np.zeros(0)]

    def add(self, words: list[str], lines: list[int]) -> None:
        try:
            values = [float(word) if word else np.nan for word in words]
            self._parts.append(np.array(values, np.float64))
        except ValueError:
            values = []
        if not values or any("_" in word for word in words):
            row = next(row for row, word in enumerate(words) if word and not _is_number(word))
            hint = " with a decimal point" if "," in words[row] else ""
            raise UserError(f"{self._path}:{lines[row]}", self._name, words[row], f"a number{hint}")

    def array(self) -> NDArray[np.float64]:
        return np.concatenate(self._parts)


class _Integers:
    """Builds a column of integers."""

    def __init__(self, path: Path, name: str):
        self._path, self._name, self._parts = path, name, [np.zeros(0, np.int64)]

    def add(self, words: list[str], lines: list[int]) -> None:
        values = [_integer(word) for word in words]
        for word, line, value in zip(words, lines, values, strict=True):
            if value is None:
                raise UserError(f"{self._path}:{line}", self._name, word or "nothing", "an integer")
        self._parts.append(np.array(values, np.int64))

    def array(self) -> NDArray[np.int64]:
        return np.concatenate(self._parts)


class _Words:
    """Builds a column of texts."""

    def __init__(self, path: Path, name: str):
        self._path, self._name = path, name
        self._codes, self._code_of, self._n_characters = array("i"), {"": -1}, 0

    def add(self, words: list[str], lines: list[int]) -> None:
        for word, line in zip(words, lines, strict=True):
            code = self._code_of.get(word)
            if code is None:
                self._check(word, line)
                code = self._code_of[word] = len(self._code_of) - 1
            self._codes.append(code)

    def _check(self, word: str, line: int) -> None:
        where = f"{self._path}:{line}"
        if len(word) > MAX_VALUE_CHARACTERS:
            raise UserError(where, self._name, f"{len(word)} characters", f"at most {MAX_VALUE_CHARACTERS}")
        self._n_characters += len(word)
        if self._n_characters > MAX_TEXT_CHARACTERS:
            found = f"more than {MAX_TEXT_CHARACTERS} characters in different values"
            raise UserError(where, self._name, found, f"at most {MAX_TEXT_CHARACTERS}")
        try:
            word.encode()
        except UnicodeEncodeError:
            raise UserError(where, self._name, ascii(word), "text in UTF-8") from None

    def array(self) -> Texts:
        words = list(itertools.islice(self._code_of, 1, None))
        return Texts(words, np.array(self._codes, np.int32))


def _builder(kind: Kind, path: Path, name: str) -> _Numbers | _Integers | _Words:
    if kind == "number":
        return _Numbers(path, name)
    return _Integers(path, name) if kind == "integer" else _Words(path, name)


def _batch(rows: Iterator[Row]) -> list[Row]:
    """Return the next rows: so few that they need little memory, and none at the end."""
    batch: list[Row] = []
    n_characters = 0
    for line, words in rows:
        batch.append((line, words))
        n_characters += sum(map(len, words))
        if len(batch) >= _BATCH_ROWS or n_characters > _BATCH_CHARACTERS:
            break
    return batch


def _separator(line: str) -> str:
    """Return the separator that splits a line into the most values; a space if no other separator occurs."""
    counts = {separator: len(next(csv.reader(io.StringIO(line), delimiter=separator), [])) for separator in ",;\t"}
    best = max(counts, key=lambda separator: counts[separator])
    return best if counts[best] > 1 or len(line.split()) == 1 else " "


def _without_empty_end(words: list[str], min_length: int) -> list[str]:
    """Remove empty values at the end, but keep at least `min_length` values."""
    while len(words) > min_length and not words[-1]:
        words = words[:-1]
    return words


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word


def _integer(word: str) -> int | None:
    try:
        value = int(word)
    except ValueError:
        if not _is_number(word) or not (number := float(word)).is_integer():
            return None
        value = int(number)
    return value if "_" not in word and _MIN_INTEGER <= value <= _MAX_INTEGER else None
