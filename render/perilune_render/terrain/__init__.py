"""The ground of a scene as plain data, without Blender: size laws, craters, boulders and heights.

The published sources are listed in docs/reference/sources.md.
"""
