"""Frames of a dataset in memory."""
