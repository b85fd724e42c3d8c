"""Relative motion of a lander from pairs of its descent images."""
