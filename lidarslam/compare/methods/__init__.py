"""The methods of a comparison: their names, and the process of each."""
