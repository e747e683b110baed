"""Inertial measurements: the turn between and during sweeps, and the direction of gravity."""
