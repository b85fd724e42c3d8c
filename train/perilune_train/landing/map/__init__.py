"""Crater catalogues from images of an orbiter."""
