"""Crater labels of a frame, measured in its rendering."""
