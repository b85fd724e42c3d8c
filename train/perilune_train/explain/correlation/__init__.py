"""The paper's correlations PCC1 to PCC4, for each image or pair of images."""
