"""Absolute navigation by craters: a catalogue, matching detections to it, and the pose that follows."""
