"""Images from any source: read, predict, evaluate."""
