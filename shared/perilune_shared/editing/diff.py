"""Compare two datasets row by row and column by column."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.schema import KEYS, TABLES
from perilune_shared.errors import one_line, shortened

_COPY_NUMBER = "copy"
"""Name of the added key column that numbers rows with equal keys."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A column in which rows differ, or rows that exist in only one dataset."""

    table: str
    """Name of the table, or dataset.json."""
    column: str
    """Column or field; empty if whole rows are missing."""
    rows: int
    """Number of rows that differ or are missing."""
    example: str
    """Key of the first row that differs."""
    first: str
    """Value of the example in the first dataset."""
    second: str
    """Value of the example in the second dataset."""


def differences(first: Dataset, second: Dataset) -> list[Difference]:
    """Return all differences in content, whatever the division into parts and the storage of frames."""
    result = list(_info(_plain(first), _plain(second), ""))
    first_ids, second_ids = set(first.scene_ids()), set(second.scene_ids())
    for missing, values in ((first_ids - second_ids, ("present", "-")), (second_ids - first_ids, ("-", "present"))):
        if missing:
            result.append(Difference("scenes", "", len(missing), min(missing), *values))
    gathered: dict[tuple[str, str], Difference] = {}
    for scene_id in sorted(first_ids & second_ids):
        for name in TABLES:
            pair = (dataset.table(name, scene_id=scene_id).to_pandas() for dataset in (first, second))
            for each in _rows(name, *pair):
                key = (each.table, each.column + (each.first if not each.column else ""))
                earlier = gathered.get(key)
                total = each.rows + (earlier.rows if earlier else 0)
                example = earlier or each
                gathered[key] = Difference(
                    example.table, example.column, total, example.example, example.first, example.second
                )
    return result + list(gathered.values())


def _plain(dataset: Dataset) -> dict:
    return dataset.info.model_dump(mode="json", exclude={"images", "counts", "index"})


def _info(old: object, new: object, path: str) -> Iterator[Difference]:
    if old == new:
        return
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted({*old, *new}):
            yield from _info(old.get(key), new.get(key), f"{path}.{key}".lstrip("."))
        return
    yield Difference("dataset.json", path, 1, "", _text(old), _text(new))


def _rows(table: str, old: pd.DataFrame, new: pd.DataFrame) -> Iterator[Difference]:
    """Yield the differences in one table of one scene."""
    keys = KEYS[table]
    if any(frame.duplicated(keys).any() for frame in (old, new)):
        # Number rows with equal keys by their values, so that their order in the file does not matter.
        old, new = (_numbered(frame, keys) for frame in (old, new))
        keys = [*keys, _COPY_NUMBER]
    old, new = (frame.set_index(keys).sort_index() for frame in (old, new))
    only_old, only_new = old.index.difference(new.index), new.index.difference(old.index)
    for missing, values in ((only_old, ("present", "-")), (only_new, ("-", "present"))):
        if len(missing):
            yield Difference(table, "", len(missing), _text(missing[0]), *values)
    common = old.index.intersection(new.index)
    old, new = old.loc[common], new.loc[common]
    for column in old.columns:
        a, b = old[column], new[column]
        if a.map(np.ndim).gt(0).any() if a.dtype == object else False:
            differs = np.array([not np.array_equal(x, y, equal_nan=True) for x, y in zip(a, b, strict=True)], bool)
        else:
            differs = ~((a == b) | (a.isna() & b.isna())).fillna(False).to_numpy(bool)
        if differs.any():
            row = int(np.argmax(differs))
            yield Difference(
                table, column, int(differs.sum()), _text(common[row]), _text(a.iloc[row]), _text(b.iloc[row])
            )


def _numbered(rows: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Sort rows by their values, and add a column that numbers the rows with equal keys from 0."""
    plain = [name for name in rows.columns if not (rows[name].dtype == object and rows[name].map(np.ndim).gt(0).any())]
    rows = rows.sort_values(plain, kind="stable", ignore_index=True)
    return rows.assign(**{_COPY_NUMBER: rows.groupby(keys).cumcount()})


def _text(value: object) -> str:
    if isinstance(value, tuple):
        value = " ".join(map(str, value))
    return shortened(one_line(value), 60)
