"""One run on disk: its request, files, log and summary."""
