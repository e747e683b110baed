"""Comparing methods on recordings."""
