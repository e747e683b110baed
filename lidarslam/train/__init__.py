"""Training on disk."""
