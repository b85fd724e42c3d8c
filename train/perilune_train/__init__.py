"""Crater detection, landing navigation and their explanation, learned from perilune manifests alone."""

__version__ = "0.1.0"
