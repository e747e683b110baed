"""Rerun and pictures."""
