"""The recording that a run was made of, as its config.yaml names it."""

from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.datasets.config import ReaderConfig
from lidarslam.storage import directory as files


@dataclass(frozen=True)
class RunSource:
    """A recording, and which of its scans were taken."""

    path: Path
    reader: ReaderConfig
    # start, stop, step: as in `range`
    start: int
    stop: int | None
    step: int


def read_source(run: Path, purpose: str) -> RunSource:
    """The recording of a run; `purpose` ends the message if it is not there.

    Raises:
        InputError: it is unknown, or not there any more.
    """
    file = run / files.CONFIG
    try:
        content = read_yaml(file)
        about, reader = content[files.RUN_SECTION], content.get("reader") or {}
        path, stop = Path(about["source"]), about.get("stop")
        start, step = int(about.get("start", 0)), int(about.get("step", 1))
        # Of another version's settings, those that are known here.
        known = {key: value for key, value in reader.items() if key in ReaderConfig.model_fields}
        source = RunSource(path, ReaderConfig(**known), start, None if stop is None else int(stop), step)
    except (ConfigError, ValidationError, AttributeError, KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{file}: does not name the recording of the run, which {purpose}") from None
    if not path.exists():
        raise InputError(f"{path}: is not there any more; the run's recording {purpose}")
    return source
