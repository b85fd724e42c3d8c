"""Generate lunar terrain and descent trajectories, and render labelled frames."""

# Import this first: it sets environment variables that NumPy and other libraries read when they are loaded.
import perilune_render.provenance.processor  # noqa: F401

__version__ = "0.1.0"
