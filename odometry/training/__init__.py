"""Training: losses, pairs, preparation."""
