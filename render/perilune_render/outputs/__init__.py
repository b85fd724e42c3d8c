"""Outputs in addition to the frames: hazard maps of the scenes, images of a flash lidar."""
