"""Answers to the questions of a reader on single detections: why, how sure, and the effect on the position."""
