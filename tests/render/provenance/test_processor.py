"""The settings that make results independent of the processor."""

import subprocess
import sys

FOUND = """
import perilune_render, numpy
print(numpy.show_config(mode="dicts")["SIMD Extensions"].get("found", []))
"""


def test_numpy_uses_no_code_that_depends_on_the_processor():
    done = subprocess.run([sys.executable, "-c", FOUND], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
