"""Engines that render a frame: Blender's Cycles, and ray casting at the height field."""
