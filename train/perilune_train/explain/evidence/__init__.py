"""Tests of what the maps mean: nulls, interventions, localisation, stability."""
