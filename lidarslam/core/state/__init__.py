"""The state of a computation, saved and restored."""
