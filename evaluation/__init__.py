"""How good a trajectory or a map is, against a reference."""
