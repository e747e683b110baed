"""Merging several recordings of one place."""
