"""Absolute navigation by craters: a catalogue, its match with detections, and the camera pose from that match."""
