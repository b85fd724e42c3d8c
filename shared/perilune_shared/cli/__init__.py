"""Command line `perilune-manifest`."""
