"""New datasets from old ones: subset, merge, split, pack, attach, migrate; and diff."""
