"""Detections from the network's output: scales, tiles, suppression."""
