"""The street worlds."""
