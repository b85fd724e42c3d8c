"""The command line `perilune-manifest`."""
