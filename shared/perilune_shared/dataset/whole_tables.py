"""Write whole tables: the parts `all`, `all.0001` and so on, each up to a maximum number of rows."""

from collections import defaultdict

import pyarrow as pa

from perilune_shared.dataset.metadata import Counts
from perilune_shared.dataset.names import WHOLE_TABLE
from perilune_shared.dataset.parts import MAX_ROWS_WRITTEN, WrittenFile, write_part
from perilune_shared.dataset.schema import OPTIONAL_TABLES, TABLES, complete
from perilune_shared.storage.store import Store

_MIN_ROWS_PER_GROUP, _MAX_GROUPS = 1000, 200


class WholeTables:
    """Writer of all tables of a dataset. Rows stay in memory until a part is full.

    With `replace`, existing parts are overwritten. Without it, an existing part raises FileExistsError.
    """

    def __init__(self, store: Store, *, max_rows: int = MAX_ROWS_WRITTEN, replace: bool = False):
        self._store, self._max_rows, self._replace = store, max_rows, replace
        self._buffered: dict[str, list[pa.Table]] = defaultdict(list)
        self._n_buffered = dict.fromkeys(TABLES, 0)
        self._n_parts = dict.fromkeys(TABLES, 0)
        self._n_rows = dict.fromkeys(TABLES, 0)
        self._written: list[WrittenFile] = []

    @property
    def counts(self) -> Counts:
        """Number of rows added to each table."""
        return Counts(**self._n_rows)

    def add(self, name: str, rows: pa.Table) -> None:
        """Append rows to a table; write a part whenever it reaches the maximum number of rows."""
        rows = complete(name, rows)
        self._n_rows[name] += len(rows)
        while len(rows):
            free = self._max_rows - self._n_buffered[name]
            if not free:
                self._write(name)
                continue
            self._buffered[name].append(rows[:free])
            self._n_buffered[name] += len(self._buffered[name][-1])
            rows = rows[free:]

    def finish(self) -> list[WrittenFile]:
        """Write buffered rows, and an empty part for each required table without rows; return all parts."""
        for name in TABLES:
            is_needed = name not in OPTIONAL_TABLES and not self._n_parts[name]
            if self._n_buffered[name] or is_needed:
                self._write(name)
        return self._written

    def _write(self, name: str) -> None:
        rows = pa.concat_tables([TABLES[name].empty_table(), *self._buffered.pop(name, [])])
        self._n_buffered[name] = 0
        stem = f"{WHOLE_TABLE}.{self._n_parts[name]:04d}" if self._n_parts[name] else WHOLE_TABLE
        per_group = max(_MIN_ROWS_PER_GROUP, len(rows) // _MAX_GROUPS)
        self._written.append(write_part(self._store, name, stem, rows, per_group, replace=self._replace))
        self._n_parts[name] += 1
