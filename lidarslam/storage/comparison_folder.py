"""The runs in the folder of a comparison."""

import json
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.storage.directory import TRAJECTORY_TUM

COMPARISON = "comparison.json"


def run_directories(path: Path) -> list[Path]:
    """The run directories of a comparison of one recording, in its order; any other path itself.

    Raises:
        InputError: the comparison is of several recordings, has no run, or its file is damaged.
    """
    file = path / COMPARISON
    if not file.is_file() or (path / TRAJECTORY_TUM).is_file():
        return [path]
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        sequences = content.get("sequences")
        if sequences is not None:
            names = ", ".join(str(path / sequence["sequence"]) for sequence in sequences)
            raise InputError(f"{path}: compares several recordings, in worlds of their own; name one of {names}")
        runs = [Path(method["run"]) for method in content["methods"].values() if method["run"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{file}: not a comparison ({error!r}); make it again") from error
    if not runs:
        raise InputError(f"{path}: none of its methods came to a result")
    # Beside its methods' folders, or, of one of several recordings, in the same folder as these.
    return [path / run if (path / run).is_dir() else path.parent / run for run in runs]
