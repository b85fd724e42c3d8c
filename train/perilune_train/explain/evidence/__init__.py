"""Tests of what attention masks mean: nulls, interventions, localisation, stability."""
