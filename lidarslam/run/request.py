"""The request for a run."""

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lidarslam.config.settings import Config
from lidarslam.viewer.viewer import RerunMode


@dataclass(frozen=True)
class RunRequest:
    """Source, configuration and destination of a run.

    Attributes:
        source: the recording.
        out: the run directory.
        config: of the computation.
        start, stop, step: which scans, as in `range`.
        prior: TUM file of an external odometry, for `odometry.method: external`.
        rerun: no Rerun recording, one in the run directory, or that and a window.
        pcd: whether the map is written as .pcd too.
        overwrite: whether an earlier run in `out` is replaced.
        resume: whether the run in `out`, which was killed or stopped, is continued.
        resumable: whether checkpoints are saved.
    """

    source: Path
    out: Path
    config: Config
    start: int = 0
    stop: int | None = None
    step: int = 1
    prior: Path | None = None
    rerun: RerunMode = "off"
    pcd: bool = False
    overwrite: bool = False
    resume: bool = False
    resumable: bool = True


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
