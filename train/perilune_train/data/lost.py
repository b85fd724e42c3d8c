"""The error of training data that cannot be had any more."""

from perilune_shared.errors import UserError


class DataLost(UserError):
    """Training data has stopped coming, between two steps; the training loop saves its state and ends."""
