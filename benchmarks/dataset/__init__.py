"""Datasets: time of rendering, developing and reading them."""

# Before NumPy is imported, whose code perilune_render selects.
import perilune_render  # noqa: F401
