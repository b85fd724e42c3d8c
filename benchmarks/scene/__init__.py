"""Scenes: time of terrain generation; errors of radiance, labels, depth and normals."""
