"""Other ways to run: a running robot, a given map, several recordings."""
