"""Files of a dataset: trajectories, parts, resume, regenerate, develop, preview."""
