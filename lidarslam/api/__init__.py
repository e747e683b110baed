"""What `lidarslam` offers to Python programs; its names are exported by the package's root."""
