"""Errors that a user can correct.

Everything derived from `LidarSlamError` is caught once, at the command line, and printed as one line without a
traceback; its message names the expected input, the actual one, and the remedy.
"""


class LidarSlamError(Exception):
    """Base of every error a user can correct."""


class InputError(LidarSlamError):
    """A recording, a trajectory or another input file is not what it should be."""


class ConfigError(LidarSlamError):
    """The configuration is misspelt, out of range or contradicts itself."""


class OutputError(LidarSlamError):
    """A result cannot be written where it was asked for."""
