"""Make datasets from others (subset, merge, split, pack, attach, migrate) and compare them (diff)."""
