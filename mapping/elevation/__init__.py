"""Estimating the error of a sensor's elevations."""
