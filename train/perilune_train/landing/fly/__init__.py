"""Fly the filter over the files of one descent: frames, camera, catalogue and measurements."""
