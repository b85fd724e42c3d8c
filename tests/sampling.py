"""Long lists of similar cases, of which `make test` runs some."""

from collections.abc import Iterable

import pytest


def every(n: int, cases: Iterable[object]) -> list:
    """Make parameters of a test from all cases; only every n-th one, from the first on, is not slow."""
    made = []
    for place, case in enumerate(cases):
        values = case if isinstance(case, tuple) else (case,)
        made.append(pytest.param(*values, marks=[pytest.mark.slow] if place % n else []))
    return made
