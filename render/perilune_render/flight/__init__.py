"""Plans: scenes, perturbed trajectories, poses, and the checks of poses."""
