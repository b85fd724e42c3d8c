"""Scenes: speed of the terrain, radiance and labels compared with the geometry."""
