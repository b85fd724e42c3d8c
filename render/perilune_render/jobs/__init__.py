"""Jobs: render a planned dataset in three steps, in this process, in worker processes or on many machines."""
