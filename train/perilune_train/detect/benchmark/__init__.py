"""The locked benchmark of crater detection: its parts, submissions of other detectors, scores, page."""
