"""A robot that is running: its clouds over DDS, published poses, and the results of a run."""
