"""The report of a demo, a paper run or a benchmark: one HTML file without other files, and a summary."""
