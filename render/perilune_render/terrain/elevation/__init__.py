"""Real ground: an elevation model, its craters, and the ground beyond its edge."""
