"""`python -m lidarslam`."""

from lidarslam.cli import entry_point

entry_point()
