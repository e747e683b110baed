"""The files of a run: written while it lasts, and read back."""
