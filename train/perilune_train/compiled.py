"""Compile functions with numba."""

from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable) -> Any:
    """Compile a function at its first call, and keep the machine code beside the source or in the user's cache.

    numba compiles again only if the function's file changes, so the function must not use functions or constants of
    other files. A division by zero gives infinity or NaN, as in NumPy.
    """
    options = {"nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # neither folder can be written
        return numba.njit(**options)(function)
