"""Casting rays into worlds."""
