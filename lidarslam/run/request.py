"""The requests for runs: of a recording, and of a robot that is running."""

import logging
import os
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lidarslam.config.settings import Config, read_yaml
from lidarslam.core.errors import OutputError
from lidarslam.core.tasks import THREADS, usable_cores
from lidarslam.core.text import count
from lidarslam.datasets.intake import choose_scans
from lidarslam.datasets.published.evalio import resolved
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.config import MapFormat
from lidarslam.mapping.loops.closure import GivenLoops
from lidarslam.storage.directory import CONFIG, RUN_SECTION
from lidarslam.viewer.rerun_program import require_window
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

    def open(self) -> tuple[Recording, range]:
        """The recording, and the indices of the scans that are chosen of it; InputError where there are none."""
        recording = open_recording(self.source, self.config.reader)
        return recording, choose_scans(recording, self.source, self.start, self.stop, self.step)


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


def require_possible(request: RunRequest | LiveRequest, *read: Path) -> None:
    """Refuse a run without a display for its window, or into a place that it reads, before anything is computed."""
    if request.rerun == "spawn":
        require_window("serve a browser with --rerun web, or write a file with --rerun save")
    for place in read:
        require_apart(request.out, place)


def require_apart(out: Path, source: Path) -> None:
    """Refuse to write into a recording; OutputError where `out` is the source."""
    if out.resolve() == source.resolve():
        raise OutputError(f"{out}: is the recording itself; name another directory for the run")


def log_choices(request: RunRequest, scans: range, recorded: int) -> None:
    """Log the source and settings of a run that begins."""
    config = request.config
    logger.info("%s of %s, to %s", count(len(scans), "scan"), f"{recorded:,}", request.out)
    graph = "on" if config.pose_graph.enabled else "off"
    logger.info("odometry: %s; mapping: %s; pose graph: %s", config.odometry.method, config.mapping.method, graph)
    threads = ", ".join(f"{name} {os.environ.get(name, 'not set')}" for name in THREADS[:2])
    logger.info("%s of %s; %s", count(usable_cores(), "core"), os.cpu_count(), threads)


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


def written_request(run: Path, asked: Config) -> tuple[dict[str, Any], Config]:
    """The section of a run's config.yaml that describes it, as of `describe_run`, and its configuration.

    `reader.elevation_correction_deg` is 'auto' where it is in `asked`: the file has the estimated value.
    """
    tree = read_yaml(run / CONFIG)
    described, config = tree.pop(RUN_SECTION), Config.model_validate(tree)
    if asked.reader.elevation_correction_deg == "auto":
        config = config.having("reader", elevation_correction_deg="auto")
    return described, config
