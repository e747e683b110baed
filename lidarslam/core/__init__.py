"""The types that all other packages share: geometry, scans, trajectories, errors."""
