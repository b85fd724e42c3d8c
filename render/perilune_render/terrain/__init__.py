"""The ground as plain data, independent of Blender: laws, populations, heights.

Sources: docs/reference/sources.md.
"""
