"""Which code and which versions a result follows from, and the caches that are keyed by them."""
