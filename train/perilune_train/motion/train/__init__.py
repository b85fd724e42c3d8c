"""Training of the navigation networks."""
