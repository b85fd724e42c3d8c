"""Attention of the trained networks, in pictures and correlations."""
