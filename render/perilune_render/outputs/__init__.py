"""Outputs beside the frames: hazard maps of the scenes, images of a flash lidar."""
