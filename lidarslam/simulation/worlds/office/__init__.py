"""The office world."""
