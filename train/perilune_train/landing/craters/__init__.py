"""Absolute navigation by craters: catalogue, matching of detections, and camera pose."""
