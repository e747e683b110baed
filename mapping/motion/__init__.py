"""Motion of the sensor during and between sweeps."""
