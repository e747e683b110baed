"""Directions: that a LiDAR spins about, and of motion that a scan does not constrain."""
