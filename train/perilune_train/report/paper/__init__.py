"""The page of the paper's experiment: its tables, figures and claims beside those of our runs."""
