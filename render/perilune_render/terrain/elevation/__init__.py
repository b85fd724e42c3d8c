"""Real ground: an elevation model, its craters, and the ground around it."""
