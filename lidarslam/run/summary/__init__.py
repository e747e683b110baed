"""What a run leaves in numbers and words."""
