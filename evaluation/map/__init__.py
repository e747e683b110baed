"""Map metrics."""
