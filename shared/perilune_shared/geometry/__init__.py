"""Frames of reference, camera, ellipses and the nominal trajectory."""
