"""Command line `perilune-render`."""
