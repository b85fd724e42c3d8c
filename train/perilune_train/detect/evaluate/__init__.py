"""Evaluation over plain data, without torch."""
