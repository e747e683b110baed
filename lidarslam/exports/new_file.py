"""Files that are not replaced unasked."""

from pathlib import Path

from lidarslam.core.errors import OutputError


def require_new(out: Path, overwrite: bool) -> None:
    """Check that nothing is in the way of an exported file.

    Raises:
        OutputError: a file is there that is not to be replaced, or a folder.
    """
    if out.is_dir():
        raise OutputError(f"{out}: is a folder; name another place, or remove it")
    if out.exists() and not overwrite:
        raise OutputError(f"{out}: exists; name another file, or replace it with --overwrite")
