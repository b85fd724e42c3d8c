"""The terminal: command lines, messages, progress bars, Ctrl-C."""
