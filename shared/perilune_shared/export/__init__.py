"""Datasets in other formats, and the dataset card."""
