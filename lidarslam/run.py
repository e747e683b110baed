"""One run on disk: from a source to a run directory."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from evaluation.trajectory_metrics import TrajectoryMetrics, evaluate_trajectory
from lidarslam import run_directory as files
from lidarslam.config import Config, dump_yaml
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import format_kitti, format_tum, read_tum
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.localisation import Localiser, OdometryAlone, ScanToMap
from lidarslam.loop_closing import GraphOutcome, begin_graph, finish_graph
from lidarslam.pipeline import Pipeline, ScanResult
from lidarslam.prefetch import prefetch
from lidarslam.run_directory import RunDirectory
from lidarslam.scan_log import ScanLog
from lidarslam.summary import RunSummary, summarise
from lidarslam.viewer import NullViewer, Viewer
from mapping.config import GlobalMapConfig
from mapping.g2o import format_g2o
from mapping.global_map import GlobalMap
from mapping.map_io import write_cloud
from mapping.mapper import Mapper
from odometry.consistency import ConsistencyCheck
from odometry.interface import Odometry
from odometry.registry import make_odometry

if TYPE_CHECKING:
    from mapping.slam_graph import SlamGraph

RerunMode = Literal["off", "save", "spawn"]


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

    A recording that turns out damaged on the way, or an interruption, ends the run with what there is.

    Raises:
        LidarSlamError: the source, the configuration or the output directory is not usable.
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
        directory = stack.enter_context(RunDirectory.create(request.out, request.overwrite))
        log = stack.enter_context(ScanLog.open(directory))
        graph = begin_graph(config, directory.path)
        if graph is not None:
            stack.callback(graph.close)
        with _viewing(request, recording, directory, log) as viewer:
            tracked = track(request, recording, chosen, odometry, log, graph, viewer, progress)
            closed = _close_loops(graph, tracked.global_map, log, viewer)
        return write_results(directory, request, tracked, closed)


@dataclass(frozen=True, eq=False)
class Tracked:
    """A recording that went through the pipeline.

    Attributes:
        recording, truth, log: what it was, its ground truth, what came of it.
        asked: how many scans were asked for.
        total_ms: wall time of each scan.
        global_map: of the poses as they were found; None when no scan could be believed.
        error: what ended it before its last scan, None when nothing did.
    """

    recording: Recording
    truth: Trajectory | None
    log: ScanLog
    asked: int
    total_ms: list[float]
    global_map: GlobalMap | None
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
) -> Tracked:
    """Take the chosen scans of a recording through the pipeline, and log them; a graph follows.

    Raises:
        NoScanError: none could be used.
    """
    config, truth = request.config, _ground_truth(recording, log)
    pipeline = Pipeline(odometry, make_localiser(config), config.global_map, graph)
    scans = in_order(recording.scans(chosen.start, chosen.stop, chosen.step))
    watch = _Watch(log, viewer, truth, lambda number, result: progress(number, len(chosen), result))
    error = _process(pipeline, scans, watch)
    if not len(log):
        why = "" if error is None else f": {_reason(error)}"
        raise NoScanError(f"{request.source}: no scan could be used{why}", isinstance(error, KeyboardInterrupt))
    return Tracked(recording, truth, log, len(chosen), watch.total_ms, pipeline.global_map, error)


def write_results(
    directory: RunDirectory, request: RunRequest, tracked: Tracked, closed: GraphOutcome | None
) -> RunOutcome:
    """Write everything but the log of the scans: their poses are final by now, and a graph has drawn its map."""
    config, log = request.config, tracked.log
    directory.write_text(files.CONFIG, dump_yaml(config, _describe(request)))
    global_map = tracked.global_map if closed is None else closed.global_map
    if closed is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(closed.graph))
    metrics = _write_trajectories(directory, tracked.recording.T_cam_lidar, tracked.truth, log)
    map_points = write_map(directory, global_map, config.global_map, request.pcd)
    voxel_size_m = None if global_map is None else global_map.voxel_size_m
    skipped = 0 if tracked.stopped else tracked.asked - len(log)
    summary = summarise(log, tracked.total_ms, map_points, voxel_size_m, skipped, closed)
    directory.write_json(files.SUMMARY, summary.to_json())
    return RunOutcome(summary, metrics, tracked.stopped)


def require_apart(out: Path, source: Path) -> None:
    """See that nothing is written into a recording.

    Raises:
        OutputError: it would be.
    """
    if out.resolve() == source.resolve():
        raise OutputError(f"{out}: is the recording itself; name another directory for the run")


def in_order(scans: Iterable[Scan]) -> Iterator[Scan]:
    """The scans whose stamps increase; no trajectory could hold the others."""
    latest = -np.inf
    for scan in scans:
        if scan.stamp > latest:
            latest = scan.stamp
            yield scan


@dataclass
class _Watch:
    """Everyone who is told of each scan, and the wall time each took, milliseconds."""

    log: ScanLog
    viewer: Viewer
    truth: Trajectory | None
    progress: Callable[[int, ScanResult], None]
    total_ms: list[float] = field(default_factory=list)

    def see(self, result: ScanResult, global_map: GlobalMap | None) -> None:
        """One more scan is done."""
        index = len(self.log)
        if index == 0:
            _show_reference(self.viewer, self.truth, result.stamp)
        self.log.add(result)
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


def write_map(directory: RunDirectory, global_map: GlobalMap | None, config: GlobalMapConfig, pcd: bool) -> int:
    """Write the map, unless it is empty; how many points it has."""
    if global_map is None:
        return 0
    cloud = global_map.cloud(config.normal_neighbours, config.min_hits)
    if not len(cloud):
        return 0
    for name in (files.MAP_PLY, files.MAP_PCD) if pcd else (files.MAP_PLY,):
        with directory.replacing(name) as path:
            write_cloud(path, cloud)
    return len(cloud)
