"""Labels of frames: named thresholds, selections by them, and crater masks."""
