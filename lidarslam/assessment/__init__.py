"""Evaluating runs and trajectory files on disk."""
