"""The surfel map and its compiled loops."""
