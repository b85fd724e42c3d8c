"""The page of the paper's experiment: the paper's tables, figures and claims beside the results of our runs."""
