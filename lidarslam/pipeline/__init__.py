"""The pipeline: scan, odometry, mapping, pose graph."""
