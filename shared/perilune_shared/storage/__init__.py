"""Files: atomic writing, locks, hashes, and reading with limits."""
