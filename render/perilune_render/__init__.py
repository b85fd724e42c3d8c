"""Procedural lunar terrain, perturbed descent trajectories and labelled frames, rendered offline by Blender."""

# Before NumPy is imported anywhere.
import perilune_render.provenance.processor  # noqa: F401

__version__ = "0.1.0"
