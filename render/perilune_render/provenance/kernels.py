"""numba.njit with a machine code cache that is keyed by the sources of all kernels.

numba's own cache only checks the file of the function, although functions and constants of other files are compiled
into it. Here a change to any of them selects a new cache folder.
"""

from collections.abc import Callable
from typing import Any

import numba

from perilune_render.provenance.caches import machine_code_folder


def njit(**options: Any) -> Callable[[Callable], Any]:
    """`numba.njit(cache=True)` with the machine code in `machine_code_folder()`; other threads may run meanwhile."""

    def decorate(function: Callable) -> Any:
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(machine_code_folder())
        try:
            return numba.njit(cache=True, nogil=True, **options)(function)
        finally:
            numba.config.CACHE_DIR = before

    return decorate
