"""The folder of a comparison: its files, the recordings' folders, and in these the runs, one per method."""

from pathlib import Path

from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.json_text import ANY_OBJECT, read_json
from lidarslam.core.text import require_name
from lidarslam.storage.directory import TRAJECTORY_TUM

# Each recording's folder holds its own comparison.json, where there are several.
COMPARISON, REPORT_HTML, REPORT_MD = "comparison.json", "report.html", "report.md"
# Next to the recordings' folders: recordings that a benchmark has made.
RECORDINGS = "recordings"
RESERVED = frozenset({COMPARISON, REPORT_HTML, REPORT_MD, RECORDINGS})


def run_directories(path: Path) -> list[Path]:
    """The run directories of a comparison of one recording, in its order; any other path itself.

    InputError where the comparison is of several recordings, has no run, or its file is damaged.
    """
    file = path / COMPARISON
    if not file.is_file() or (path / TRAJECTORY_TUM).is_file():
        return [path]
    try:
        content = read_json(file, ANY_OBJECT)
        sequences = content.get("sequences")
        if sequences is not None:
            names = ", ".join(str(path / sequence["sequence"]) for sequence in sequences)
            raise InputError(f"{path}: compares several recordings, in worlds of their own; name one of {names}")
        places = [method["run"] for method in content["methods"].values() if method["run"]]
        # A recording's name and a method's: a comparison names no runs elsewhere.
        runs = [Path(*(require_name(part, "run") for part in place.split("/"))) for place in places]
    except (OSError, ValueError, KeyError, TypeError, ConfigError) as error:
        raise InputError(f"{file}: not a comparison ({error!r}); make it again") from error
    if not runs:
        raise InputError(f"{path}: none of its methods came to a result")
    # Next to its methods' folders, or, of one of several recordings, in the same folder as these.
    return [path / run if (path / run).is_dir() else path.parent / run for run in runs]
