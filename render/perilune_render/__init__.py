"""Procedural lunar terrain, perturbed descents and labelled frames, rendered offline by Blender."""

__version__ = "0.1.0"
