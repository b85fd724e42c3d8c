"""Numbers and tables in Markdown."""

import math
from collections.abc import Sequence


def number(value: object) -> str:
    """A number with three decimals; a dash if undefined."""
    return f"{value:.3f}" if isinstance(value, int | float) and math.isfinite(value) else "-"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table; escapes vertical bars within cells."""
    lines = [[cell.replace("|", "\\|") for cell in row] for row in (head, *rows)]
    lines.insert(1, ["---"] * len(head))
    return ["| " + " | ".join(row) + " |" for row in lines]
