"""The ground as plain data, independent of Blender: laws, populations, height field."""
