"""Trajectories, sequences of image pairs, batches."""
