"""A robot that is running: its clouds over DDS, poses in return, and the results of a run."""
