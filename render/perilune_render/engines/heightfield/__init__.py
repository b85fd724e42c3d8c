"""The engine `heightfield`: casts rays at the ground with NumPy and numba, without Blender."""
