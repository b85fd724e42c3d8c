"""Records of the code and libraries that determine a result, and caches keyed by their versions."""
