"""What the attention of the trained networks looks at, in pictures and correlations."""
