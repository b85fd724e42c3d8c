"""Tests of perilune."""

import contextlib

# Before NumPy is imported, whose code perilune_render selects; it is not installed where only the trainer is tested.
with contextlib.suppress(ImportError):
    import perilune_render  # noqa: F401
