"""Slow benchmarks; `make help` lists their targets, and `python -m benchmarks.train.size` runs one directly."""

from perilune_shared.threads import set_up_program

# Before torch or NumPy is imported.
set_up_program()
