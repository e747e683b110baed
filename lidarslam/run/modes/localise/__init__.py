"""A recording localised in a finished map, on disk."""
