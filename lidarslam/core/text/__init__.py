"""Text: trajectory files, and untrusted names on one line."""
