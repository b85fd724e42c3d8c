"""Procedural lunar terrain, perturbed descent trajectories and labelled frames, rendered offline by Blender."""

__version__ = "0.1.0"
