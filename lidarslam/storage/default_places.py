"""Default places of results, and of the run to read, when no directory is named."""

import re
from datetime import datetime
from itertools import count
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.core.text import safe_name
from lidarslam.datasets.published.evalio import full_name, is_of_evalio, resolved
from lidarslam.datasets.registry import takes_sequence
from lidarslam.storage.directory import TRAJECTORY_TUM
from lidarslam.storage.unfinished import About

RUNS = Path("runs")
_TIME = "%Y-%m-%d_%H-%M-%S"
# Of a simulated recording that was itself written to a default place.
_TIMED = re.compile(r"_\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d(-\d+)?$")


def new_place(folder: Path, name: str) -> Path:
    """A path that does not exist yet: FOLDER/NAME_TIME, with the local time; a number follows if the name is taken."""
    first = folder / f"{safe_name(name)}_{datetime.now():{_TIME}}"
    numbered = (first.with_name(f"{first.name}-{number}") for number in count(2))
    return first if not first.exists() else next(path for path in numbered if not path.exists())


def source_name(source: Path, sequence: str | None = None) -> str:
    """The name for the results of a recording: its file or folder, without suffix and time.

    Of a folder with several sequences, followed by the one that is read; of evalio's, with that of the data set.
    """
    source = resolved(source)
    if is_of_evalio(source):
        return safe_name(full_name(source))
    name = _TIMED.sub("", source.name if source.is_dir() else source.stem)
    chooses = sequence not in (None, source.name) and takes_sequence(source)
    return safe_name(f"{name}_{sequence}" if chooses else name)


def latest_run() -> Path | None:
    """The run in `runs` whose trajectory was written last; None without any. Running ones are left out."""
    runs = (path.parent for path in RUNS.glob(f"*/{TRAJECTORY_TUM}"))
    found = [run for run in runs if (about := _about(run)) is None or about.standing != "at work"]
    return max(found, key=lambda run: (run / TRAJECTORY_TUM).stat().st_mtime, default=None)


def unfinished_run(source: Path, sequence: str | None = None) -> Path:
    """The only unfinished run of a recording in `runs`; InputError where there is none, or there are several."""
    found = [path for path in sorted(RUNS.glob("*/")) if _is_of(path, source, sequence)]
    if not found:
        raise InputError(
            f"{RUNS}: holds no unfinished run of {source}; name one with --out, or leave --resume out to begin one"
        )
    if len(found) > 1:
        listed = ", ".join(map(str, found))
        raise InputError(f"{source}: has several unfinished runs ({listed}); name the one to resume with --out")
    return found[0]


def _is_of(run: Path, source: Path, sequence: str | None) -> bool:
    about = _about(run)
    if about is None or "merge" in about.description:
        return False
    reader = about.description.get("reader")
    same_sequence = not isinstance(reader, dict) or reader.get("sequence") == sequence
    return about.description.get("source") == str(resolved(source)) and same_sequence


def _about(run: Path) -> About | None:
    """The unfinished run there; None also where its file is damaged."""
    try:
        return About.read(run)
    except InputError:
        return None
