"""Runs: folders, fitting with Lightning, resume."""
