"""Engines that render a frame: Blender (Cycles), and rays over the height field without Blender."""
