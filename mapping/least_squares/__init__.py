"""Gauss-Newton steps and their degenerate directions."""
