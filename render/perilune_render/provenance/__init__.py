"""The code and versions that determine a result, and the caches keyed by them."""
