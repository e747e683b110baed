"""The hall world."""
