"""Licences as SPDX expressions."""

import functools
import re
from collections.abc import Iterable
from typing import Any

from license_expression import ExpressionError, Licensing, get_spdx_licensing

from perilune_shared.errors import UserError

_CUSTOM = re.compile(r"(LicenseRef-|AdditionRef-)[A-Za-z0-9.-]+")


@functools.cache
def _spdx() -> Licensing:
    # Cached: reading the list of licences takes 0.03 s.
    return get_spdx_licensing()


def joined_licence(licences: Iterable[tuple[object, str]]) -> str:
    """Return the SPDX expression that joins the given licences by AND.

    `licences` are pairs of dataset (for error messages) and licence. Equal licences appear once; alternatives are in
    parentheses. A licence that SPDX does not list needs a name of the form LicenseRef-<name>. Raises UserError on an
    invalid SPDX expression or an unknown licence.
    """
    spdx = _spdx()
    terms: dict[str, str] = {}
    for where, text in licences:
        for term in _terms(spdx, where, text):
            # Terms that differ only in the order of alternatives are equal when simplified.
            terms.setdefault(str(term.simplify()), str(term))
    parsed = [spdx.parse(term) for _, term in sorted(terms.items())]
    return str(spdx.AND(*parsed)) if len(parsed) > 1 else str(parsed[0])


def _terms(spdx: Licensing, where: object, text: str) -> list[Any]:
    """Return the terms that a licence expression joins by AND."""
    expected = "an SPDX licence expression such as CC-BY-4.0, or LicenseRef-<name>"
    try:
        expression = spdx.parse(text)
        if expression is None:
            raise UserError(where, "licence", "nothing", expected)
        unknown = [key for key in spdx.unknown_license_keys(expression) if not _CUSTOM.fullmatch(key)]
    except (ExpressionError, ValueError, TypeError, RecursionError) as error:
        raise UserError(where, "licence", f"{text!r} ({error})", expected) from None
    if unknown:
        raise UserError(where, "licence", ", ".join(unknown), expected)
    pending, terms = [expression], []
    while pending:
        term = pending.pop(0)
        if isinstance(term, spdx.AND):
            pending = [*term.args, *pending]
        else:
            terms.append(term)
    return terms
