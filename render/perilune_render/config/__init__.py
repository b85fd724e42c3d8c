"""The section `dataset`: settings of a dataset with their units, bounds and defaults."""
