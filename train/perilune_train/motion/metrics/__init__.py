"""Baselines without training, errors of estimated motions, pictures."""
