"""numba.njit with a machine code cache that is keyed by the sources of all kernels.

numba's own cache checks only the file of the function, although the machine code also contains functions and constants
of other files. Here, a change to any kernel, or to the functions and constants that it uses, selects a new cache
folder. If several processes need a kernel for the first time, one process compiles it and the others wait.
"""

from collections.abc import Callable
from typing import Any

import numba
from numba.core.compiler_lock import global_compiler_lock

from perilune_render.provenance.caches import compiling, machine_code_folder


def njit(**options: Any) -> Callable[[Callable], Any]:
    """`numba.njit(cache=True)` with the machine code in `machine_code_folder()`; kernels release the GIL."""

    def decorate(function: Callable) -> Any:
        folder = machine_code_folder()
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
        try:
            kernel = numba.njit(cache=True, nogil=True, **options)(function)
        finally:
            numba.config.CACHE_DIR = before
        if numba.config.DISABLE_JIT:
            return kernel
        compile_or_load = kernel.compile

        def compile_alone(signature: Any) -> Any:
            # Take numba's thread lock first: a thread that compiles a caller holds it and waits here for the callee.
            with global_compiler_lock, compiling(folder / f"{function.__module__}.{function.__qualname__}.lock"):
                return compile_or_load(signature)

        kernel.compile = compile_alone
        return kernel

    return decorate
