"""Datasets: time of rendering, developing and reading them."""
