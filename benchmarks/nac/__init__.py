"""Rendered frames compared with crops of the Narrow Angle Camera (NAC)."""
