"""What a run is asked for."""

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lidarslam.config.settings import Config
from lidarslam.viewer.viewer import RerunMode


@dataclass(frozen=True)
class RunRequest:
    """What is to be run, how, and where it goes.

    Attributes:
        source: the recording.
        out: the run directory.
        config: how it is computed.
        start, stop, step: which scans, as in `range`.
        prior: TUM file of an external odometry, for `odometry.method: external`.
        rerun: no Rerun recording, one in the run directory, or one there and a window.
        pcd: whether the map is written as .pcd too.
        overwrite: whether an earlier run in `out` is replaced.
        resume: whether the run in `out`, which was killed or stopped, is gone on with.
        resumable: whether the state is saved now and then, so that it can be.
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
    """What was run, for config.yaml."""
    return {
        "version": version("lidarslam"),
        "source": str(request.source.resolve()),
        "start": request.start,
        "stop": request.stop,
        "step": request.step,
        "prior": None if request.prior is None else str(request.prior.resolve()),
    }
