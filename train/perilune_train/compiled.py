"""Functions that numba compiles."""

from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable) -> Any:
    """The function, compiled at its first call; the machine code is kept beside the source or in the user's cache.

    Kept code is compiled again only if the file of the function changes: it must use no function and no constant of
    another file. Divisions by zero give infinity or NaN, as in NumPy.
    """
    options = {"nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # neither folder can be written
        return numba.njit(**options)(function)
