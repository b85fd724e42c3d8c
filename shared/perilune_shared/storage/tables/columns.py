"""Columns that were read from a table, with the line of each row so that messages can state it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError

Kind = Literal["number", "integer", "text"]
"""Type of a column: float64 with NaN for missing values, int64, or text."""


@dataclass(frozen=True, slots=True)
class Texts:
    """A column of texts. Equal texts are stored once to save memory."""

    words: list[str]
    """The distinct texts (m,)."""
    codes: NDArray[np.int32]
    """Index in `words` of each row's text (n,); -1 if the row has no value."""

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, row: int) -> str:
        """Return the text of a row, or "" if it has no value."""
        code = self.codes[row]
        return self.words[code] if code >= 0 else ""

    def to_list(self) -> list[str]:
        """Return the texts of all rows."""
        words = [*self.words, ""]
        return [words[code] for code in self.codes]


@dataclass(frozen=True, slots=True)
class Columns:
    """The requested columns of a table; requested columns that the table lacks are omitted."""

    path: Path
    """Path of the file."""
    arrays: dict[str, NDArray[np.float64] | NDArray[np.int64] | Texts]
    """Columns by name, each (n,)."""
    n_rows: int
    """Number of rows n."""
    lines: NDArray[np.int64] | None
    """Line of each row in the file (n,), from 1; None for Parquet."""

    def __contains__(self, name: str) -> bool:
        return name in self.arrays

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Return a column that was read as "number" (n,); NaN if a row has no value."""
        values = self.arrays[name]
        assert isinstance(values, np.ndarray)
        return values.astype(np.float64, copy=False)

    def integers(self, name: str) -> NDArray[np.int64]:
        """Return a column that was read as "integer" (n,)."""
        values = self.arrays[name]
        assert isinstance(values, np.ndarray)
        return values.astype(np.int64, copy=False)

    def texts(self, name: str) -> Texts:
        """Return a column that was read as "text"."""
        values = self.arrays[name]
        assert isinstance(values, Texts)
        return values

    def finite(self, name: str, low: float = -np.inf, high: float = np.inf) -> NDArray[np.float64]:
        """Return a column of finite numbers from `low` to `high` (n,).

        Raises UserError about the first other value.
        """
        values = self.numbers(name)
        self.check(name, np.isfinite(values) & (values >= low) & (values <= high), _range_text(low, high))
        return values

    def check(self, name: str, fits: NDArray[np.bool_], expected: str) -> None:
        """Raise UserError about the first row for which `fits` (n,) is false."""
        if not fits.all():
            raise self.fault(int(fits.argmin()), name, expected)

    def fault(self, row: int, name: str, expected: str) -> UserError:
        """Return a UserError about the value in a column and a row, counted from 0."""
        values = self.arrays[name]
        value: object = values[row]
        if isinstance(values, Texts):
            value = repr(value) if value else "nothing"
        elif isinstance(value, np.floating):
            value = "nothing" if np.isnan(value) else float(value)
        return UserError(*self.at(row, name), value, expected)

    def at(self, row: int, name: str) -> tuple[str, str]:
        """Return the location of a value, as the first two arguments of UserError.

        For text: file and line, then column. For Parquet: file, then column and row, counted from 0.
        """
        if self.lines is None:
            return str(self.path), f"{name}: row {row}"
        return f"{self.path}:{self.lines[row]}", name


def check_unique(path: Path, names: Sequence[str], wanted: Sequence[str]) -> None:
    """Raise UserError if a wanted column occurs more than once."""
    for name in wanted:
        if (number := names.count(name)) > 1:
            raise UserError(path, "columns", f"{number} times {name}", f"{name} once")


def check_present(path: Path, names: Sequence[str], required: Sequence[str]) -> None:
    """Raise UserError if a required column is missing."""
    missing = [name for name in required if name not in names]
    if missing:
        found = ", ".join(names[:20]) or "none"
        raise UserError(path, "columns", f"no {', '.join(missing)}; columns {found}", ", ".join(required))


def _range_text(low: float, high: float) -> str:
    if np.isfinite(low) and np.isfinite(high):
        return f"a number from {low:g} to {high:g}"
    return "a finite number" + (f", at least {low:g}" if np.isfinite(low) else "")
