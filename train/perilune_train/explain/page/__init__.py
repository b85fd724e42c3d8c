"""Pictures, claims and verdicts of an explain run."""
