"""Plans: scenes, perturbed trajectories, poses, and checks of the poses."""
