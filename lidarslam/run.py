"""One run on disk: from a source to a run directory."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evaluation.trajectory_metrics import TrajectoryMetrics
from lidarslam import run_directory as files
from lidarslam.config import Config, dump_yaml
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import read_tum
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.localisation import make_localiser
from lidarslam.loop_closing import GraphOutcome, close_loops
from lidarslam.pipeline import Pipeline, ScanResult
from lidarslam.resuming import describe_computed, lost_before
from lidarslam.run_directory import RunDirectory
from lidarslam.run_state import begin, keeper_of, log_and_graph, restore
from lidarslam.run_watch import Watch, process, reason
from lidarslam.scan_log import ScanLog
from lidarslam.summary import RunSummary, WrittenMap, summarise
from lidarslam.trajectory_files import ground_truth, write_trajectories
from lidarslam.unfinished import Unfinished
from lidarslam.viewer import RerunMode, Viewer, viewing
from mapping.config import GlobalMapConfig
from mapping.g2o import format_g2o
from mapping.global_map import GlobalMap
from mapping.map_io import write_cloud
from mapping.visibility import PlacedViews, Views, seen_through
from odometry.interface import Odometry
from odometry.registry import make_odometry

if TYPE_CHECKING:
    from mapping.slam_graph import SlamGraph


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


@dataclass(frozen=True)
class RunOutcome:
    """What a run came to.

    Attributes:
        summary: the run in numbers.
        metrics: its errors, when the recording came with ground truth for it.
        stopped: why it ended before its last scan, None when it did not.
    """

    summary: RunSummary
    metrics: TrajectoryMetrics | None
    stopped: str | None = None


Progress = Callable[[int, int, ScanResult], None]
"""Called after every scan with its number from 1, how many there are, and what became of it."""


def execute(request: RunRequest, progress: Progress) -> RunOutcome:
    """Run, and write the run directory.

    A recording that turns out damaged on the way, or an interruption, ends the run with what there is. A run that is
    killed leaves a folder from which it can be resumed to the results it would have had.

    Raises:
        LidarSlamError: the source, the configuration or the output directory is not usable, or there is nothing to
            resume.
    """
    require_apart(request.out, request.source)
    config = request.config
    recording = open_recording(request.source, config.reader)
    chosen = range(len(recording))[request.start : request.stop : request.step]
    if not chosen:
        raise InputError(
            f"{request.source}: none of its {len(recording)} scans is left after --start, --stop and --step"
        )
    with ExitStack() as stack:
        odometry = open_odometry(config, request.prior)
        stack.callback(odometry.close)
        directory = stack.enter_context(RunDirectory.create(request.out, request.overwrite, request.resume))
        unfinished = _claim(request, recording, stack)
        log, graph = log_and_graph(config, directory, unfinished, stack)
        with viewing(request.rerun, recording.name, config.viewer, directory, log) as viewer:
            tracked = track(request, recording, chosen, odometry, log, graph, viewer, progress, unfinished)
            closed = close_loops(graph, tracked.global_map, log, viewer)
        outcome = write_results(directory, request, tracked, closed)
    if unfinished is not None:
        unfinished.end(outcome.stopped is not None)
    return outcome


def lost_when_finished(request: RunRequest) -> int | None:
    """How many scans were lost, if `out` holds this very run with nothing left to resume; None if it does not.

    Raises:
        InputError: it holds another one.
    """
    return lost_before(request.out, request.config, _describe(request))


def _claim(request: RunRequest, recording: Recording, stack: ExitStack) -> Unfinished | None:
    """What makes a run resumable."""
    if not request.resumable:
        return None
    description = describe_computed(request.config, recording, _describe(request), request.prior)
    return stack.enter_context(Unfinished.claim(request.out, description, request.resume))


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
    return Tracked(
        recording, truth, log, len(chosen), faults, watch.total_ms, pipeline.global_map, pipeline.views, error
    )


def _why_none(log: ScanLog, faults: Faults, error: InputError | KeyboardInterrupt | None) -> Iterator[str]:
    if error is not None:
        yield reason(error)
    yield from faults.warnings()
    if len(log):
        yield f"{len(log)} scans without a valid point, {log.points_dropped} invalid ones (NaN, at the origin, too far)"


def write_results(
    directory: RunDirectory, request: RunRequest, tracked: Tracked, closed: GraphOutcome | None
) -> RunOutcome:
    """Write everything but the log of the scans: their poses are final by now, and a graph has drawn its map."""
    config, log = request.config, tracked.log
    directory.write_text(files.CONFIG, dump_yaml(config, _describe(request)))
    global_map = tracked.global_map if closed is None else closed.global_map
    if closed is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(closed.graph))
    metrics = write_trajectories(directory, tracked.recording, tracked.truth, log)
    views = tracked.views.placed(log.trajectory.T_world_lidar)
    written = write_map(directory, global_map, views, config.global_map, request.pcd)
    log.warnings.extend(tracked.faults.warnings())
    skipped = 0 if tracked.stopped else tracked.asked - len(log) - tracked.faults.left_out
    summary = summarise(log, tracked.total_ms, written, skipped, closed)
    directory.write_json(files.SUMMARY, summary.to_json())
    return RunOutcome(summary, metrics, tracked.stopped)


def require_apart(out: Path, source: Path) -> None:
    """See that nothing is written into a recording.

    Raises:
        OutputError: it would be.
    """
    if out.resolve() == source.resolve():
        raise OutputError(f"{out}: is the recording itself; name another directory for the run")


def open_odometry(config: Config, prior: Path | None) -> Odometry:
    """The odometry that is configured; whoever asks for it closes it.

    Raises:
        LidarSlamError: the configuration contradicts itself, or a file is not what it should be.
    """
    method = config.odometry.method
    if method == "constant-velocity" and not config.mapping.enabled:
        raise ConfigError(
            "constant-velocity only predicts; without scan-to-map refinement it would stand still."
            " Choose --odometry learned, give a trajectory with --prior, or leave --no-mapping out"
        )
    if method == "external" and prior is None:
        raise ConfigError("odometry.method is external: give its trajectory with --prior FILE")
    return make_odometry(config.odometry, None if prior is None else read_tum(prior))


def _describe(request: RunRequest) -> dict[str, Any]:
    """What was run, for config.yaml."""
    return {
        "version": version("lidarslam"),
        "source": str(request.source.resolve()),
        "start": request.start,
        "stop": request.stop,
        "step": request.step,
        "prior": None if request.prior is None else str(request.prior.resolve()),
    }


def write_map(
    directory: RunDirectory, global_map: GlobalMap | None, views: PlacedViews, config: GlobalMapConfig, pcd: bool
) -> WrittenMap:
    """Write the map without what the views see through, unless it is empty."""
    if global_map is None:
        return WrittenMap(0, None, 0)
    moved = seen_through(global_map.points(config.min_hits), views, global_map.voxel_size_m)
    cloud = global_map.cloud(config.normal_neighbours, config.min_hits, moved)
    written = WrittenMap(len(cloud), global_map.voxel_size_m, int(moved.sum()))
    if not len(cloud):
        return written
    for name in (files.MAP_PLY, files.MAP_PCD) if pcd else (files.MAP_PLY,):
        with directory.replacing(name) as path:
            write_cloud(path, cloud)
    return written
