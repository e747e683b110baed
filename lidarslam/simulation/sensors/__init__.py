"""LiDAR models: scan patterns and noise."""
