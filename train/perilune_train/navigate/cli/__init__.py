"""The subcommands of `perilune-train navigate`."""
