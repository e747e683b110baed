"""Networks, weights and inference."""
