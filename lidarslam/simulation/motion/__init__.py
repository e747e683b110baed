"""Motions of carriers through worlds."""
