"""Errors that a user can mend.

Everything derived from `LidarSlamError` is caught once, at the command line, and printed as one line without a
traceback; its message says what was expected, what came, and what to do.
"""


class LidarSlamError(Exception):
    """Base of every error a user can mend."""


class InputError(LidarSlamError):
    """A recording, a trajectory or another input file is not what it should be."""


class ConfigError(LidarSlamError):
    """The configuration is misspelt, out of range or contradicts itself."""


class OutputError(LidarSlamError):
    """A result cannot be written where it was asked for."""
