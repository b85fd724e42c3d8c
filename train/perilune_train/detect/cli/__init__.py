"""The command line `perilune-train detect`."""
