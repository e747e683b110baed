"""Worlds, sensors and motions: recordings whose truth is known exactly."""
