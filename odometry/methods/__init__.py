"""The odometry methods."""
