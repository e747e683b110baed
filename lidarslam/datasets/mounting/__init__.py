"""Recordings of sensors that are not mounted upright, or whose axes are not x forward, z up."""
