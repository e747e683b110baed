"""Point-to-plane alignment of range images."""
