"""One world a file."""
