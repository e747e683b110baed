"""Stamps of scans and times of points."""
