"""Settings with which numerical libraries compute equal digits on all x86-64 CPUs with AVX2 and FMA.

NumPy, OpenBLAS, OpenCV and numba select their code by the processor, and OpenBLAS also by the number of threads. Both
choices change the last digits. The libraries read these environment variables when they are loaded, so
`perilune_render` imports this module first. Results on processors without AVX2 and FMA still differ, since the C
library (sin, exp, log, power), OpenCV and Cycles have different code for them.
"""

import os
import sys

SETTINGS = {
    # Use NumPy's baseline code: its code for AVX-512 gives different last digits in log, power and other functions.
    # NumPy 2.4 and later have other names for the same features; NumPy ignores names that it does not know.
    "NPY_DISABLE_CPU_FEATURES": "SSSE3 SSE41 POPCNT SSE42 AVX F16C FMA3 AVX2 AVX512F AVX512CD AVX512_KNL AVX512_KNM"
    " AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR X86_V3 X86_V4",
    # These need SSE 4.2, as Blender does.
    "OPENBLAS_CORETYPE": "Nehalem",
    "OPENBLAS_NUM_THREADS": "1",
    "NUMBA_CPU_NAME": "x86-64-v2",
    "NUMBA_CPU_FEATURES": "",
    "NUMBA_DISABLE_INTEL_SVML": "1",
    # OpenCV uses AVX2 and FMA, if the processor has them, as Cycles does.
    "OPENCV_CPU_DISABLE": "AVX512-SKX",
    "OPENCV_IPP": "sse42",
}
"""Environment variables and their values."""
IN_FORCE = "numpy" not in sys.modules or all(os.environ.get(name) == value for name, value in SETTINGS.items())
"""Whether the settings were set before NumPy was imported. If not, results depend on this processor, and recipes record
this fact."""

os.environ.update(SETTINGS)
