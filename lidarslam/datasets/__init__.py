"""Readers, one per file; the registry lists them."""
