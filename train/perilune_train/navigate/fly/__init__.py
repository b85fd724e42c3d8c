"""Fly the filter over files of one descent: anybody's frames, camera, catalogue and measurements."""
