"""Effect of single craters on networks: craters are removed from the ground, and frames are rendered again."""
