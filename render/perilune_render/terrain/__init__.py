"""The ground as plain data: laws, populations, height field. Knows nothing of Blender."""
