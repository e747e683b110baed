"""Errors of a trajectory or a map relative to a reference."""
