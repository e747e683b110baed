"""Scan-to-map registration, tracking, loop closure, pose graph and global map."""
