"""Trained navigators as files for flight."""
