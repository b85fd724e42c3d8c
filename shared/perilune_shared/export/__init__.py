"""Export datasets to other formats, and write the dataset card."""
