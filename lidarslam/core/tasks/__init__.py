"""Independent tasks: one after another in this process, or side by side as tasks of Ray."""
