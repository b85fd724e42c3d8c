"""The pose of a lander over known craters: catalogue, pose fixes, navigation filter, flights, crater maps."""
