"""The request for a run."""

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lidarslam.config.settings import Config
from lidarslam.mapping.config import MapFormat
from lidarslam.viewer.viewer import RerunMode


@dataclass(frozen=True)
class RunRequest:
    """Source, configuration and destination of a run."""

    source: Path  # the recording
    out: Path  # the run directory
    config: Config  # of the computation
    # start, stop, step: which scans, as in `range`
    start: int = 0
    stop: int | None = None
    step: int = 1
    prior: Path | None = None  # TUM file of an external odometry, for `odometry.method: external`
    rerun: RerunMode = "off"  # no Rerun recording, one in the run directory, or that and a browser or a window
    map_formats: tuple[MapFormat, ...] = ()  # what the map is written as beside .ply
    overwrite: bool = False  # whether an earlier run in `out` is replaced
    resume: bool = False  # whether the run in `out`, which was killed or stopped, is continued
    resumable: bool = True  # whether checkpoints are saved
    report: bool = False  # whether a page and pictures are drawn, once all else is written


def describe_run(request: RunRequest) -> dict[str, Any]:
    """The section of config.yaml about what was run."""
    return {
        "version": version("lidarslam"),
        "source": str(request.source.resolve()),
        "start": request.start,
        "stop": request.stop,
        "step": request.step,
        "prior": None if request.prior is None else str(request.prior.resolve()),
    }
