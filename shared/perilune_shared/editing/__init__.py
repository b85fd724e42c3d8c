"""Make datasets from other datasets: subset, merge, split, pack, attach, migrate. Compare them: diff."""
