"""Worlds for carriers that walk: a corridor into a yard, a stairwell, a foyer full of people."""
