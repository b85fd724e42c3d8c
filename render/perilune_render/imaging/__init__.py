"""Camera images from rendered radiance."""
