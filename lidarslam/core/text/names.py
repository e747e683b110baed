"""Names that become parts of paths: each a single component, so that what is joined to a folder stays in it."""

import re
from collections.abc import Collection
from pathlib import PurePosixPath

from lidarslam.core.errors import ConfigError
from lidarslam.core.text.plain_text import one_line

# Bytes; file systems allow 255, and a number, a time or a suffix may follow.
_LONGEST = 120
_SEPARATORS = re.compile(r"[/\\]+")
_REMEDY = "name it with letters, digits, '-', '_', '.' or '+', without a dot at the beginning"


def require_name(name: str, what: str, reserved: Collection[str] = ()) -> str:
    """The name, if it is a safe component of a path: no separator, no control character, not hidden, not too long.

    Args:
        name: of unknown origin.
        what: it is the name of, for the error.
        reserved: names of other files beside it.

    Raises:
        ConfigError: it is none.
    """
    fault = _fault(name, reserved)
    if fault is not None:
        raise ConfigError(f"{what} {name[:_LONGEST]!r}: cannot be the name of a folder, as it {fault}; {_REMEDY}")
    return name


def safe_name(text: str, default: str = "recording") -> str:
    """A safe component of a path for something that has a name already, such as a topic or a sequence."""
    name = one_line(_SEPARATORS.sub("_", text)).replace("\\", "_").lstrip(".")
    name = name.encode()[:_LONGEST].decode(errors="ignore")
    return name if name.strip() else default


def stays_below(path: str) -> bool:
    """Whether a relative path, with / between its parts, leads to no place outside the folder that it is joined to."""
    parts = PurePosixPath(path)
    return not parts.is_absolute() and ".." not in parts.parts


def _fault(name: str, reserved: Collection[str]) -> str | None:
    if not name.strip():
        return "is empty"
    if _SEPARATORS.search(name):
        return "has a separator"
    if name.startswith("."):
        return "begins with a dot"
    if one_line(name) != name:
        return "has a control character, or is too long"
    if len(name.encode()) > _LONGEST:
        return f"is longer than {_LONGEST} bytes"
    return "is that of another file there" if name in reserved else None
