"""The vocabulary every other package speaks: geometry, scans, trajectories, errors."""
