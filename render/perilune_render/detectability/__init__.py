"""Detectability of crater labels: frames with and without each crater, and an ideal observer with local clutter."""
