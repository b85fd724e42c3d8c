"""Effect of single craters, removed from the ground and rendered again."""
