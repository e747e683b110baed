"""The application: recordings in, trajectories and maps out."""
