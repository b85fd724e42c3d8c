"""Craters of a scene: population, profiles, stamping on the ground, and measurement of rims."""
