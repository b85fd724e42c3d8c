"""Frames and labels for the detector."""
