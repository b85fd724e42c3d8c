"""Every fault of a dataset, with its file and row."""
