"""The page of limits states what the code enforces."""

from pathlib import Path

from perilune_shared.storage.tables import limits

PAGE = Path(__file__).parents[4] / "docs/reference/limits.md"


def test_the_page_lists_the_limits_of_every_table():
    text = PAGE.read_text(encoding="utf-8")
    section = text.partition("## Tables")[2].partition("## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ") and line[-3].isdigit()]
    assert rows == [f"| {kind.kind} | {kind.rows:,} | {kind.file_bytes:,} |" for kind in limits.KINDS]
    numbers = (
        limits.MAX_LINE_BYTES,
        limits.MAX_COLUMNS,
        limits.MAX_VALUE_CHARACTERS,
        limits.MAX_TEXT_CHARACTERS,
        limits.SPARE_ROWS,
    )
    for number in numbers:
        assert f"{number:,}" in text
    assert f"n / {limits.BYTES_PER_ROW} rows" in text
