"""Scan-to-scan motion: every method behind one protocol."""
