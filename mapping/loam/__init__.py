"""LOAM features."""
