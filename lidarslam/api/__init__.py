"""The Python interface of `lidarslam`; its names are exported by the package's root."""
