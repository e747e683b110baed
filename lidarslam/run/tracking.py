"""How a recording goes through the pipeline: its scans taken in, everyone told of each, the state kept."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lidarslam.core.errors import InputError
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.recording import Recording
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.resume.run_state import begin, keeper_of, restore
from lidarslam.resume.unfinished import Unfinished
from lidarslam.run.request import RunRequest
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.trajectory_files import ground_truth
from lidarslam.run.watch import Progress, Watch, process, reason
from lidarslam.viewer.viewer import Viewer
from mapping.global_map.global_map import GlobalMap
from mapping.global_map.moved_points import Views
from mapping.slides.slides import PairTests
from odometry.interface import Odometry

if TYPE_CHECKING:
    from mapping.pose_graph.slam_graph import SlamGraph


@dataclass(frozen=True, eq=False)
class Tracked:
    """A recording that went through the pipeline.

    Attributes:
        recording, truth, log: what it was, its ground truth, what came of it.
        asked: how many scans were asked for.
        faults: what was left out of them, and what is wrong with them.
        total_ms: wall time of each scan.
        global_map: of the poses as they were found; None when no scan could be believed.
        views: of some of its scans, for what moved.
        slides: pairs of its scans, held against one another.
        error: what ended it before its last scan, None when nothing did.
    """

    recording: Recording
    truth: Trajectory | None
    log: ScanLog
    asked: int
    faults: Faults
    total_ms: list[float]
    global_map: GlobalMap | None
    views: Views
    slides: PairTests
    error: InputError | KeyboardInterrupt | None

    @property
    def stopped(self) -> str | None:
        """Why it ended before its last scan."""
        return None if self.error is None else reason(self.error)


class NoScanError(InputError):
    """No scan of a recording could be used, because of an interruption or of the recording."""

    def __init__(self, message: str, interrupted: bool) -> None:
        super().__init__(message)
        self.interrupted = interrupted


def track(
    request: RunRequest,
    recording: Recording,
    chosen: range,
    odometry: Odometry,
    log: ScanLog,
    graph: "SlamGraph | None",
    viewer: Viewer,
    progress: Progress,
    unfinished: Unfinished | None = None,
) -> Tracked:
    """Take the chosen scans of a recording through the pipeline, and log them; a graph follows.

    Args:
        request: what is run.
        recording, chosen: its source, and which scans of that.
        odometry, log, graph: for the pipeline; log and graph as they were saved, where the run is resumed.
        viewer, progress: told of every scan.
        unfinished: where the state is saved, and was; None: nowhere.

    Raises:
        NoScanError: none could be used.
        InputError: the recording is not the one that the run was begun with.
    """
    config, truth = request.config, ground_truth(recording, log)
    with suppress(InputError):  # it is told when the scans are read
        for warning in recording.warnings:
            log.warn(warning)
    faults = Faults()
    scans = take_in(recording, chosen, faults)
    watch = Watch(log, viewer, truth, lambda number, result: progress(number, len(chosen), result))
    keeper = None if unfinished is None else keeper_of(config, unfinished, watch, graph)
    pipeline = Pipeline(odometry, make_localiser(config), config.global_map, graph, keeper)
    if unfinished is not None:
        if unfinished.saved is not None:
            scans = restore(unfinished.saved, pipeline, watch, scans, odometry)
        begin(unfinished, log, request.out, request.resume, request.rerun != "off")
    error = process(pipeline, scans, watch)
    if not log.points_read:
        why = "; ".join(_why_none(log, faults, error))
        raise NoScanError(f"{request.source}: no scan could be used: {why}", isinstance(error, KeyboardInterrupt))
    slides = pipeline.slides.tests
    return Tracked(
        recording, truth, log, len(chosen), faults, watch.total_ms, pipeline.global_map, pipeline.views, slides, error
    )


def _why_none(log: ScanLog, faults: Faults, error: InputError | KeyboardInterrupt | None) -> Iterator[str]:
    if error is not None:
        yield reason(error)
    yield from faults.warnings()
    if len(log):
        yield f"{len(log)} scans without a valid point, {log.points_dropped} invalid ones (NaN, at the origin, too far)"
