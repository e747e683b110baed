"""Detecting maps that contradict themselves."""
