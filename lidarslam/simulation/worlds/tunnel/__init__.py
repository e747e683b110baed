"""The tunnel world."""
