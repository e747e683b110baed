"""Values and tables of a comparison."""
