"""Kill renderings at random moments, resume them, and compare the finished datasets byte by byte."""
