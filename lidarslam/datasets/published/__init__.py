"""Data sets in the layouts in which their authors publish them; one file for each, and one for KITTI's three."""
