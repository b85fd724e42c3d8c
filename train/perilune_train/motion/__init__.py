"""Motion of a lander from its frames: navigators (networks) and classical methods."""
