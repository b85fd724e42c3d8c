"""Prints the number of hostile inputs, the peak of memory and the longest time after the tests."""

import json
import os
from pathlib import Path

import pytest

from tests.hostile.measured import MEASURED

_HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """`make test` leaves these tests to `make test-hostile`, which .ci/run calls."""
    for item in items:
        if _HERE in item.path.parents:
            item.add_marker(pytest.mark.hostile)


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter) -> None:
    """Print the summary of the file that all processes of the run have written."""
    path = os.environ.get(MEASURED)
    if path is None or not Path(path).is_file():
        return
    rows = [json.loads(line) for line in Path(path).read_text(encoding="utf-8").splitlines()]
    if rows:
        most = max(rows, key=lambda row: row["memory_mb"])
        longest = max(rows, key=lambda row: row["seconds"])
        terminalreporter.write_line(
            f"{len(rows)} hostile inputs; peak memory {most['memory_mb']:.0f} MB ({most['name']}); "
            f"longest time {longest['seconds']:.1f} s ({longest['name']})"
        )
