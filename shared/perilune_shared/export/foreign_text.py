"""Make untrusted text safe to write to Markdown, Markdown code spans and CSV.

Names of files, runs, datasets and classes, licences, and messages of other libraries are untrusted. The functions call
`errors.one_line`, which also makes text safe to print in a terminal. They do not escape HTML for reports; Jinja2 does.
"""

import os
import re
import string
import unicodedata
from typing import TYPE_CHECKING, Any

from perilune_shared.errors import one_line, shortened

if TYPE_CHECKING:
    import pandas as pd

_MARKUP = str.maketrans({character: f"\\{character}" for character in "\\`*_[]<>#~&$!@"})
_LINK = re.compile(r"(:(?=//)|(?<=www)\.)", re.IGNORECASE)
"""Text that GitHub recognises as the start of a web address."""
_IN_CODE = frozenset(string.ascii_letters + string.digits + " ._+,:()/%=?-")
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "|", "%")
"""First characters by which spreadsheet programs recognise a formula or a command in a cell."""


def for_markdown(value: object) -> str:
    """Return text as one line that Markdown shows literally, without markup, HTML, links or pictures.

    Vertical bars are not escaped; callers that write tables escape them in every cell.
    """
    return _LINK.sub(r"\\\1", one_line(value).translate(_MARKUP))


def code_span(value: object) -> str:
    """Return text as a code span that is safe in Markdown, in its tables and in HTML.

    Characters other than letters, digits and safe punctuation become question marks.
    """
    text = "".join(c if c in _IN_CODE or (c.isalnum() and c.isprintable()) else "?" for c in one_line(value))
    return f"`{shortened(text, 200).strip() or 'none'}`"


def for_csv(value: str) -> str:
    """Return text as a CSV cell that spreadsheet programs do not read as a formula.

    Text that begins like a formula is prefixed with an apostrophe.
    """
    text = one_line(value)
    # Spreadsheet programs also accept full-width signs, and skip blanks and quotes before a sign.
    first = unicodedata.normalize("NFKC", text.lstrip("'\" "))[:1]
    return f"'{text}" if first in _FORMULA and first else text


def write_csv(table: "pd.DataFrame", path: str | os.PathLike[str], **options: Any) -> None:
    """Write a table as CSV without the index; `for_csv` makes texts and column names safe.

    `options` are passed to `DataFrame.to_csv`.
    """
    safe = table.rename(columns=for_csv)
    for index, kind in enumerate(safe.dtypes):
        if str(kind) in ("object", "str", "string"):
            cells = [for_csv(cell) if isinstance(cell, str) else cell for cell in safe.iloc[:, index]]
            safe.isetitem(index, cells)
    safe.to_csv(path, index=False, **options)
