"""Rendered frames compared with crops of the Narrow Angle Camera (NAC)."""

# Before NumPy is imported, whose code perilune_render selects.
import perilune_render  # noqa: F401
