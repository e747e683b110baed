"""Multi-session mapping: several recordings merged into one map."""
