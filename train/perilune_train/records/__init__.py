"""Terrain records, marks and intervals for the evaluations of all networks."""
