"""Worlds in the open: park, forest, fields."""
