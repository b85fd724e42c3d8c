"""Evaluation of detections on plain arrays, without torch."""
