"""Scenes: time of terrain generation; errors of radiance, labels, depth and normals."""

# Before NumPy is imported, whose code perilune_render selects.
import perilune_render  # noqa: F401
