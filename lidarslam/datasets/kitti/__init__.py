"""KITTI odometry and raw data."""
