"""Validate datasets: find every fault, with file and row."""
