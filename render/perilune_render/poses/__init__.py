"""Poses that a user gives: their files, and the plan of the frames that are rendered from them."""
