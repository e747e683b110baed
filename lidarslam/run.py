"""One run on disk: from a source to a run directory."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from evaluation.trajectory_metrics import TrajectoryMetrics, evaluate_trajectory
from lidarslam import run_directory as files
from lidarslam.checkpoints import Checkpoints
from lidarslam.config import Config, dump_yaml
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import format_kitti, format_tum, read_tum
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.localisation import Localiser, OdometryAlone, ScanToMap
from lidarslam.loop_closing import GraphOutcome, begin_graph, finish_graph, restore_graph
from lidarslam.pipeline import Pipeline, ScanResult
from lidarslam.prefetch import prefetch
from lidarslam.resuming import describe_computed, lost_before, scans_left
from lidarslam.run_directory import RunDirectory
from lidarslam.scan_log import ScanLog
from lidarslam.summary import RunSummary, WrittenMap, summarise
from lidarslam.unfinished import Unfinished
from lidarslam.viewer import NullViewer, Viewer
from mapping.config import GlobalMapConfig
from mapping.g2o import format_g2o
from mapping.global_map import GlobalMap
from mapping.map_io import write_cloud
from mapping.mapper import Mapper
from mapping.visibility import PlacedViews, Views, seen_through
from odometry.consistency import ConsistencyCheck
from odometry.interface import Odometry
from odometry.registry import make_odometry

if TYPE_CHECKING:
    from mapping.slam_graph import SlamGraph

logger = logging.getLogger(__name__)

RerunMode = Literal["off", "save", "spawn"]
# How the sentence in the summary begins.
_RESUMED = "the run was resumed "


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
        unfinished = _claim(request, recording, directory, stack)
        log, graph = _log_and_graph(config, directory, unfinished, stack)
        with _viewing(request, recording, directory, log) as viewer:
            tracked = track(request, recording, chosen, odometry, log, graph, viewer, progress, unfinished)
            closed = _close_loops(graph, tracked.global_map, log, viewer)
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


def _claim(request: RunRequest, recording: Recording, directory: RunDirectory, stack: ExitStack) -> Unfinished | None:
    """What makes a run resumable."""
    if not request.resumable:
        return None
    description = describe_computed(request.config, recording, _describe(request), request.prior)
    return stack.enter_context(Unfinished.claim(request.out, description, request.resume, lambda: directory.is_mixed))


def _log_and_graph(
    config: Config, directory: RunDirectory, unfinished: Unfinished | None, stack: ExitStack
) -> tuple[ScanLog, "SlamGraph | None"]:
    """New, or as they were saved."""
    if unfinished is None:
        log, graph = stack.enter_context(ScanLog.open(directory)), begin_graph(config, directory.path)
    elif unfinished.saved is None:
        log = stack.enter_context(ScanLog.open(directory, unfinished.rows))
        graph = begin_graph(config, file=unfinished.submaps)
    else:
        saved = unfinished.saved
        log = stack.enter_context(ScanLog.open(directory, unfinished.rows, saved.part("log")))
        graph = saved.optional("graph", lambda part: restore_graph(config, part, unfinished.submaps))
    if graph is not None:
        stack.callback(graph.close)
    return log, graph


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
        return None if self.error is None else _reason(self.error)


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
    config, truth = request.config, _ground_truth(recording, log)
    with suppress(InputError):  # it is told when the scans are read
        for warning in recording.warnings:
            log.warn(warning)
    faults = Faults()
    scans = take_in(recording, chosen, faults)
    watch = _Watch(log, viewer, truth, lambda number, result: progress(number, len(chosen), result))
    keeper = None if unfinished is None else _keeper(config, unfinished, watch, graph)
    pipeline = Pipeline(odometry, make_localiser(config), config.global_map, graph, keeper)
    if unfinished is not None:
        if unfinished.saved is not None:
            scans = _restore(unfinished.saved, pipeline, watch, scans, odometry)
        _begin(request, unfinished, log)
    error = _process(pipeline, scans, watch)
    if not log.points_read:
        why = "; ".join(_why_none(log, faults, error))
        raise NoScanError(f"{request.source}: no scan could be used: {why}", isinstance(error, KeyboardInterrupt))
    return Tracked(
        recording, truth, log, len(chosen), faults, watch.total_ms, pipeline.global_map, pipeline.views, error
    )


def _why_none(log: ScanLog, faults: Faults, error: InputError | KeyboardInterrupt | None) -> Iterator[str]:
    if error is not None:
        yield _reason(error)
    yield from faults.warnings()
    if len(log):
        yield f"{len(log)} scans without a valid point, {log.points_dropped} invalid ones (NaN, at the origin, too far)"


def _keeper(config: Config, unfinished: Unfinished, watch: "_Watch", graph: "SlamGraph | None") -> Checkpoints:
    """Saves everything that a run is made of."""

    def rest() -> State:
        saved = None if graph is None else graph.state()
        return {"graph": saved, "log": watch.log.state(), "total_ms": np.array(watch.total_ms)}

    return Checkpoints(unfinished, config.checkpoints, rest, watch.log.warn)


def _restore(
    saved: Saved, pipeline: Pipeline, watch: "_Watch", scans: Iterator[Scan], odometry: Odometry
) -> Iterator[Scan]:
    """Go on from a state; of all the scans, those that are left."""
    part = saved.part("pipeline")
    pipeline.restore(part)
    if pipeline.held is None:
        raise saved.refuse("no scan is held")
    watch.total_ms = saved.array("total_ms", (len(watch.log),)).tolist()
    return scans_left(scans, pipeline.held, odometry, part)


def _begin(request: RunRequest, unfinished: Unfinished, log: ScanLog) -> None:
    """From here on the run is at work; of one that was resumed the summary says so."""
    unfinished.begin(len(log) if request.resume else None)
    was_saved, unfinished.saved = unfinished.saved is not None, None  # what is in use by now need not be held twice
    resumed = unfinished.about.resumed_after
    if not resumed:
        return
    if not was_saved:
        logger.warning("%s: nothing was saved yet; the run begins from the start", request.out)
    elif request.rerun != "off":
        log.warn(f"{files.RERUN} holds the scans from {len(log)} on; lidarslam view shows the whole run")
    times = "once" if len(resumed) == 1 else f"{len(resumed)} times"
    log.warnings = [warning for warning in log.warnings if not warning.startswith(_RESUMED)]
    log.warn(f"{_RESUMED}{times}, after {', '.join(map(str, resumed))} scans; the peak memory is that of the last part")


def write_results(
    directory: RunDirectory, request: RunRequest, tracked: Tracked, closed: GraphOutcome | None
) -> RunOutcome:
    """Write everything but the log of the scans: their poses are final by now, and a graph has drawn its map."""
    config, log = request.config, tracked.log
    directory.write_text(files.CONFIG, dump_yaml(config, _describe(request)))
    global_map = tracked.global_map if closed is None else closed.global_map
    if closed is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(closed.graph))
    metrics = _write_trajectories(directory, _camera(tracked.recording, log), tracked.truth, log)
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


@dataclass
class _Watch:
    """Everyone who is told of each scan, and the wall time each took, milliseconds."""

    log: ScanLog
    viewer: Viewer
    truth: Trajectory | None
    progress: Callable[[int, ScanResult], None]
    total_ms: list[float] = field(default_factory=list)
    _is_truth_shown: bool = False

    def see(self, result: ScanResult, global_map: GlobalMap | None) -> None:
        """One more scan is done."""
        index = len(self.log)
        self.log.add(result)
        if not self._is_truth_shown:
            _show_reference(self.viewer, self.truth, self.log.stamps[0])
            self._is_truth_shown = True
        self.viewer.show_scan(index, result)
        if global_map is not None and self.viewer.wants_map(index):
            self.viewer.show_map(global_map.points())
        self.progress(index + 1, result)


def _process(pipeline: Pipeline, scans: Iterable[Scan], watch: _Watch) -> InputError | KeyboardInterrupt | None:
    """Take every scan through the pipeline; what ended it early, None when nothing did."""
    finished = time.perf_counter()
    try:
        with closing(pipeline.run(prefetch(scans))) as results:
            for result in results:
                watch.see(result, pipeline.global_map)
                last, finished = finished, time.perf_counter()
                watch.total_ms.append(1e3 * (finished - last))
    except (InputError, KeyboardInterrupt) as error:
        watch.log.warn(f"stopped after {len(watch.log)} scans: {_reason(error)}")
        # A scan may have been logged whose time was not.
        watch.total_ms.extend([0.0] * (len(watch.log) - len(watch.total_ms)))
        return error
    return None


def _reason(error: InputError | KeyboardInterrupt) -> str:
    return str(error) or "interrupted"


def _close_loops(
    graph: "SlamGraph | None", global_map: GlobalMap | None, log: ScanLog, viewer: Viewer
) -> GraphOutcome | None:
    """Correct what was logged, once all scans are there."""
    if graph is None or global_map is None:
        return None
    closed = finish_graph(graph, len(log), global_map.voxel_size_m)
    if closed is not None:
        log.correct(closed.T_world_lidar)
        pairs = [(loop.first_scan, loop.second_scan) for loop in closed.accepted if loop.second_scan < len(log)]
        viewer.show_closed(log.trajectory.positions, pairs, closed.global_map)
    return closed


def _ground_truth(recording: Recording, log: ScanLog) -> Trajectory | None:
    """The recording's truth; a damaged one costs the metrics, not the run."""
    try:
        return recording.ground_truth
    except InputError as error:
        log.warn(f"no metrics: {error}")
        return None


def _camera(recording: Recording, log: ScanLog) -> FloatArray | None:
    """T_cam_lidar; a damaged calibration costs the camera's frame, not the run."""
    try:
        return recording.T_cam_lidar
    except InputError as error:
        log.warn(f"{files.TRAJECTORY_KITTI} is in the LiDAR's frame: {error}")
        return None


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


def make_localiser(config: Config) -> Localiser:
    """Scan-to-map refinement when it is enabled, else the odometry's word."""
    if config.mapping.enabled:
        return ScanToMap(Mapper(config.mapping))
    return OdometryAlone(ConsistencyCheck(config.odometry.consistency))


@contextmanager
def _viewing(request: RunRequest, recording: Recording, directory: RunDirectory, log: ScanLog) -> Iterator[Viewer]:
    """The viewer of the run; its recording takes its name in the run directory when all is shown."""
    if request.rerun == "off":
        yield NullViewer()
        return
    from lidarslam.rerun_viewer import IncompleteRecordingError, RerunViewer, require_complete

    try:
        with directory.replacing(files.RERUN) as path:
            viewer = RerunViewer(recording.name, request.config.viewer, path, request.rerun == "spawn")
            try:
                yield viewer
            finally:
                viewer.close()
            require_complete(path)
    except IncompleteRecordingError as error:  # it costs the picture of the run, not the run
        log.warn(f"no {files.RERUN}: {error}")


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


def _show_reference(viewer: Viewer, ground_truth: Trajectory | None, first_stamp: float) -> None:
    """Show the truth in the run's world: where both have the first scan, they coincide."""
    if ground_truth is None or len(ground_truth) < 2:
        return
    nearest = np.clip(first_stamp, ground_truth.stamps[0], ground_truth.stamps[-1])
    T_truth_first = ground_truth.at(np.array([nearest]))[0]
    viewer.show_reference(ground_truth.transformed(inverse(T_truth_first)))


def _write_trajectories(
    directory: RunDirectory, T_cam_lidar: FloatArray | None, truth: Trajectory | None, log: ScanLog
) -> TrajectoryMetrics | None:
    trajectory = log.trajectory
    directory.write_text(files.TRAJECTORY_TUM, format_tum(trajectory))
    directory.write_text(files.ODOMETRY_TUM, format_tum(log.odometry))
    poses = trajectory.T_world_lidar
    if T_cam_lidar is not None:  # the devkit compares camera poses
        poses = T_cam_lidar @ poses @ inverse(T_cam_lidar)
    directory.write_text(files.TRAJECTORY_KITTI, format_kitti(poses))
    if truth is None:
        return None
    try:
        metrics = evaluate_trajectory(trajectory, truth)
    except InputError as error:
        log.warn(f"no metrics: {error}")
        return None
    directory.write_json(files.METRICS, metrics.to_json())
    return metrics


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
