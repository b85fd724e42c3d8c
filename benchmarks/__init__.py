"""Slow benchmarks; `make help` lists their targets, and `python -m benchmarks.train.size` runs one directly."""
