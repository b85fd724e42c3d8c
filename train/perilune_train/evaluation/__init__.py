"""What evaluations of all networks share: terrain records, marks, intervals."""
