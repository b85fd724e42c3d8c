"""Evaluation of detections over plain data, without torch."""
