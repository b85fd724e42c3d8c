"""Numbers, tables and pages in Markdown.

Untrusted text enters a page only through `for_markdown` or `code_span` of `perilune_shared.export.foreign_text`.
"""

import math
import re
from collections.abc import Sequence
from pathlib import Path

from perilune_shared.storage.files import write_text

_CODE = re.compile(r"(`[^`\n]*`)")
_FENCE = re.compile(r"^```", re.MULTILINE)


def number(value: object) -> str:
    """A number as text with three decimals; a dash if undefined."""
    return f"{value:.3f}" if isinstance(value, int | float) and math.isfinite(value) else "-"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table. Vertical bars within cells are escaped."""
    lines = [[cell.replace("|", "\\|") for cell in row] for row in (head, *rows)]
    lines.insert(1, ["---"] * len(head))
    return ["| " + " | ".join(row) + " |" for row in lines]


def write_markdown(path: Path, text: str) -> None:
    """Write a page of Markdown. Escapes HTML outside of code, and replaces control characters by question marks."""
    prose_and_code = _FENCE.split(text)
    prose_and_code[::2] = [_without_html(prose) for prose in prose_and_code[::2]]
    write_text(path, "".join(c if c.isprintable() or c == "\n" else "?" for c in "```".join(prose_and_code)))


def _without_html(prose: str) -> str:
    spans = _CODE.split(prose)
    spans[::2] = [re.sub(r"(?<!\\)<", r"\<", text) for text in spans[::2]]
    return "".join(spans)
