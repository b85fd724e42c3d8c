"""PCC1 to PCC4 of the paper, for each image, from maps over images."""
