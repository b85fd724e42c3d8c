"""A trace of the filter: every input, intermediate and output, to check other implementations."""
