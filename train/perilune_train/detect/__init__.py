"""Crater detection: anchors, assignment, loss, training, evaluation."""
