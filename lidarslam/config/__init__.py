"""The configuration: its settings, YAML in and out."""
