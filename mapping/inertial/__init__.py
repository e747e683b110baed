"""Inertial measurements beside the LiDAR's: the turn between and during sweeps, and the direction of gravity."""
