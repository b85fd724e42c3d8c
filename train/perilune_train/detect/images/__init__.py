"""Images from anywhere: read, predict, evaluate."""
