"""Worlds, one per file."""
