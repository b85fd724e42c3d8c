"""The page of the paper's experiment: its tables, figures and claims, with the results of our runs."""
