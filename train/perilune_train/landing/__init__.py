"""Estimate the pose of a lander over known craters: catalogues, fixes, navigation filter, crater maps."""
