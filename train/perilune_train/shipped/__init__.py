"""Trained networks that are installed with this package, each in a folder with its model card."""
