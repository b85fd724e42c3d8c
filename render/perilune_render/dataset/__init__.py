"""Datasets: render, resume, regenerate, develop, preview."""
