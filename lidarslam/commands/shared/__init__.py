"""What the commands share: options, names, the terminal."""
