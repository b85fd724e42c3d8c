"""Training and evaluation of networks for crater detection and landing navigation on perilune datasets."""

__version__ = "0.1.0"
