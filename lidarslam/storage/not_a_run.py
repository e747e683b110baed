"""What a path is that is no run directory, and what to do about it."""

from contextlib import suppress
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.datasets.published.unrecognised import absent
from lidarslam.datasets.registry import choose_reader
from lidarslam.storage import directory as files

_LISTED = 5
# How deep a folder is searched for runs.
_PATTERNS = tuple("*/" * depth + files.TRAJECTORY_TUM for depth in (1, 2, 3))


def not_a_run(path: Path) -> str:
    """Why nothing can be read from a path that should be a run directory."""
    if not path.exists():
        return absent(path)
    if path.is_file():
        if path.name in files.FILES and (path.parent / files.TRAJECTORY_TUM).is_file():
            return f"{path}: is a file of the run {path.parent}; name the directory"
        what = "is a file, expected a run directory"
    else:
        for pattern in _PATTERNS:
            if found := sorted(str(file.parent) for file in path.glob(pattern)):
                more = f" and {len(found) - _LISTED:,} more" if len(found) > _LISTED else ""
                return f"{path}: is no run, but holds some; name them: {', '.join(found[:_LISTED])}{more}"
        what = f"not a run directory (no {files.TRAJECTORY_TUM})"
    with suppress(InputError):
        choose_reader(path)
        return f"{path}: is a recording, {what}; make one with lidarslam run {path} --out RUN"
    return f"{path}: {what}; lidarslam run makes one from a recording"
