"""A second renderer: rays cast over the ground as a height field, without Blender.

Plain NumPy and numba.
"""
