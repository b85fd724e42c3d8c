"""Relative motion of a lander from pairs of consecutive frames."""
