"""What the renderer and the trainer agree on; knows neither of them."""

__version__ = "0.1.0"
