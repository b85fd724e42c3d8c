"""The report of a demo, a paper run or a benchmark: one self-contained HTML file, and a Markdown summary."""
