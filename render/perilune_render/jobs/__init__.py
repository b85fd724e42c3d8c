"""Render a planned dataset in this process, in worker processes or on many machines."""
