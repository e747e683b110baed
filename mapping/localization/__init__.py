"""Localisation in a finished map, which stays as it is."""
