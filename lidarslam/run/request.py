"""The requests for runs: of a recording, and of a robot that is running."""

import logging
import os
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lidarslam.config.settings import Config
from lidarslam.core.text import count
from lidarslam.datasets.published.evalio import resolved
from lidarslam.mapping.config import MapFormat
from lidarslam.mapping.loops.closure import GivenLoops
from lidarslam.viewer.viewer import RerunMode

logger = logging.getLogger(__name__)


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
    map_formats: tuple[MapFormat, ...] = ()  # formats of the map besides .ply
    overwrite: bool = False  # whether an earlier run in `out` is replaced
    resume: bool = False  # whether the run in `out`, which was killed or stopped, is continued
    resumable: bool = True  # whether checkpoints are saved
    given: GivenLoops = field(default_factory=GivenLoops)  # loop closures by hand
    report: bool = False  # whether a page and pictures are drawn, once all else is written


@dataclass(frozen=True)
class LiveRequest:
    """Topic, configuration and destination of a live run."""

    out: Path  # the run directory
    config: Config  # of the computation
    topic: str | None = None  # of the clouds; None: the only one there is
    domain: int = 0  # of DDS
    # duration_s, scans: when it ends by itself, counted from the first scan; while none comes, from the beginning
    duration_s: float | None = None
    scans: int | None = None
    queue: int = 20  # scans that may wait for registration
    odom_frame: str = "odom"  # the fixed frame of the published poses
    base_frame: str | None = None  # the frame that moves, connected to the LiDAR's by /tf_static; None: the LiDAR's own
    publish_tf: bool = True  # whether the pose is published on /tf as well
    rerun: RerunMode = "off"
    map_formats: tuple[MapFormat, ...] = ()  # formats of the map besides .ply
    overwrite: bool = False  # whether an earlier run in `out` is replaced
    report: bool = False  # whether a page and pictures are drawn, once all else is written


def log_choices(request: RunRequest, scans: range, recorded: int) -> None:
    """Log the source and settings of a run that begins."""
    config = request.config
    logger.info("%s of %s, to %s", count(len(scans), "scan"), f"{recorded:,}", request.out)
    logger.info(
        "odometry: %s; mapping: %s; pose graph: %s",
        config.odometry.method,
        config.mapping.method,
        "on" if config.pose_graph.enabled else "off",
    )
    logger.info(
        "%s of %s; OMP_NUM_THREADS %s, NUMBA_NUM_THREADS %s",
        count(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, "core"),
        os.cpu_count(),
        *(os.environ.get(name, "not set") for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")),
    )


def describe_run(request: RunRequest) -> dict[str, Any]:
    """The section of config.yaml that describes the run."""
    given = {"loops": request.given.closed, "no_loops": request.given.forbidden}
    return {
        "version": version("lidarslam"),
        "source": str(resolved(request.source)),
        "start": request.start,
        "stop": request.stop,
        "step": request.step,
        "prior": None if request.prior is None else str(request.prior.resolve()),
        **{name: [list(pair) for pair in pairs] for name, pairs in given.items() if pairs},
    }
