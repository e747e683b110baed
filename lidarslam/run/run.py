"""A run on disk: from a recording, through the pipeline, to a run directory."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.geometry import inverse
from lidarslam.core.scan import Scan
from lidarslam.core.text import count
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.config import MAPPINGS
from lidarslam.mapping.elevation import ElevationEstimator
from lidarslam.mapping.global_map.global_map import DrawnMap
from lidarslam.mapping.global_map.voxels import TileStore
from lidarslam.mapping.loops.closure import GivenLoops
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.mapping.smoothed_start import SHOWING, SmoothedStart, smoothed_start
from lidarslam.odometry.interface import ExpectingOdometry, Odometry
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.compile_ahead import CompileAhead, parts_of
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.pipeline.localisation import Localiser, ScanMapper, ScanToMap, make_localiser
from lidarslam.pipeline.map_building import MapBuilder
from lidarslam.pipeline.odometry_gate import where_needed
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import prefetch
from lidarslam.run import calibration
from lidarslam.run.checkpoints import Checkpoints, describe_computed
from lidarslam.run.interruption import Interruptions
from lidarslam.run.loop_closing import begin_graph, close_loops
from lidarslam.run.request import LiveRequest, RunRequest, describe_run, log_choices, require_possible
from lidarslam.run.results import RunOutcome, Tracked, TrackedScans, reason_of, unless_damaged, write_results
from lidarslam.run.summary import ScanLog
from lidarslam.storage.directory import RERUN, STATE, SUBMAPS, TILES, UTM, RunDirectory, Unfinished
from lidarslam.viewer.rerun_program import WebPage
from lidarslam.viewer.viewer import Viewer

if TYPE_CHECKING:  # GTSAM and SciPy take a while to load
    from lidarslam.mapping.global_map.georeference import ProjectedTrack
    from lidarslam.mapping.inertial.inertial import Inertial
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph

logger = logging.getLogger(__name__)

R = TypeVar("R", RunRequest, LiveRequest)
Progress = Callable[[int, int, ScanEstimate], None]
"""Called after every scan with its number from 1, how many there are, and its result."""


class NoScanError(InputError):
    """No scan of a recording could be used, because of an interruption or of the recording."""

    def __init__(self, message: str, interrupted: bool) -> None:
        super().__init__(message)
        self.interrupted = interrupted


def execute(
    request: RunRequest, progress: Progress, phase: Callable[[str], None] = lambda _: None, page: WebPage | None = None
) -> RunOutcome:
    """Run, and write the run directory.

    A damaged recording or an interruption ends the run early, with the results so far. A run that is killed can be
    resumed, to the same results. `phase` is called with a short text on the progress before the first scan and after
    the last; the page shows the run in browsers, with `rerun="web"`.
    """
    require_possible(request, request.source)
    phase("opening the recording")
    recording, chosen = request.open()
    _require_given(request.given, len(chosen))
    log_choices(request, chosen, len(recording))
    calibration.imu_samples(request.config, recording)
    gnss = gnss_track(request)
    with open_session(request, phase, recording) as session:
        if request.resumable:
            claim = Unfinished.claim(session.directory, describe_computed(request, recording), request.resume)
            session.unfinished = session.opened.enter_context(claim)
        session.begin_graph(request.given, takes_gnss=True)
        if request.config.mapping.budget_ms is not None:
            session.log.warn("with mapping.budget_ms the results depend on the clock; another run may differ")
        session.show(recording.name, page)
        session.wait_for_loops()
        session.request, recording = calibration.with_elevations(request, recording, chosen, phase)
        phase("reading the first scans")
        tracked = track(session, recording, chosen, progress, session.graph)
        session.end_scans()
        return session.finish(tracked, describe_run(session.request), gnss)


def gnss_track(request: RunRequest) -> "ProjectedTrack | None":
    """The GNSS track of a recording, in UTM; None where the pose graph uses none."""
    if not (request.config.pose_graph.enabled and request.config.pose_graph.gnss):
        return None
    from lidarslam.exports.geo import read_gnss, utm_around
    from lidarslam.mapping.global_map.georeference import ProjectedTrack

    track = read_gnss(request.source, request.config.reader)
    utm = utm_around(track.geodetic)
    return ProjectedTrack(track, utm.project(track.geodetic), utm.scale)


def _require_given(given: GivenLoops, scans: int) -> None:
    for option, pairs in (("--loop", given.closed), ("--no-loop", given.forbidden)):
        for first, second in pairs:
            if second >= scans:
                raise InputError(f"{option} {first} {second}: the run has {scans} scans, from 0 to {scans - 1}")


@dataclass(eq=False)
class RunSession(Generic[R]):
    """A run in progress; opened with `open_session`, or by itself for scans that are only tracked."""

    request: R
    directory: RunDirectory
    odometry: Odometry
    phase: Callable[[str], None] = lambda _: None  # called with a short text on the progress
    unfinished: Unfinished | None = None  # where checkpoints are saved
    graph: "SlamGraph | None" = None
    log: ScanLog = field(default_factory=ScanLog)
    viewer: Viewer = field(default_factory=Viewer)
    outcome: RunOutcome | None = None  # once the results are written
    gnss: "ProjectedTrack | None" = None  # that they were written with
    interruptions: Interruptions = field(default_factory=Interruptions)
    compiling: CompileAhead | None = None
    opened: ExitStack = field(default_factory=ExitStack)  # closed before the directory
    shown: ExitStack = field(default_factory=ExitStack)  # closed with the last that is shown, before the summary

    def begin_graph(self, given: GivenLoops | None = None, takes_gnss: bool = False) -> None:
        """Begin the pose graph, where there is one, or resume that of the checkpoint."""
        file = None if self.unfinished is None else self.unfinished.run / SUBMAPS
        self.graph = begin_graph(self.request.config, self.directory.path, file, takes_gnss, given)
        if self.graph is not None:
            self.opened.callback(self.graph.close)
            if self.unfinished is not None and self.unfinished.saved is not None:
                self.graph.restore(self.unfinished.saved["graph"])

    def show(self, name: str, page: WebPage | None) -> None:
        """Open the viewer; a Rerun recording that cannot be written is a warning."""
        if self.request.rerun != "off":
            self.viewer = self.shown.enter_context(self._viewing(name, page))

    @contextmanager
    def _viewing(self, name: str, page: WebPage | None) -> Iterator[Viewer]:
        from lidarslam.viewer.rerun_recording import IncompleteRecordingError, rerun_viewer

        viewer, spawn = self.request.config.viewer, self.request.rerun == "spawn"
        try:
            with self.directory.replacing(RERUN) as path, rerun_viewer(name, viewer, path, spawn, page) as shown:
                yield shown
        except IncompleteRecordingError as error:
            self.log.warn(f"no {RERUN}: {error}")

    def take(self, estimate: ScanEstimate, total_ms: float, built: MapBuilder) -> None:
        """Log and show a scan, and at intervals the map."""
        self.log.add(estimate, total_ms)
        index = len(self.log) - 1
        self.viewer.show_scan(index, estimate)
        if built.global_map is not None and self.viewer.wants_map(index):
            self.viewer.show_map(built.global_map.points())

    def wait_for_loops(self) -> None:
        """Wait until loops are compiled."""
        if self.compiling is not None:
            self.compiling.wait(self.phase)

    def end_scans(self) -> None:
        """From here on a request to end the run waits for the results."""
        self.interruptions.protect_results()
        self.phase("writing the results")

    def finish(self, tracked: Tracked, described: dict[str, Any], gnss: "ProjectedTrack | None" = None) -> RunOutcome:
        """Close the loops, with a GNSS track where there is one, and write everything, after `end_scans`."""
        request, unfinished, self.gnss = self.request, self.unfinished, gnss
        closed = close_loops(self.graph, tracked.global_map, self.log, self.viewer, gnss)
        outcome = write_results(
            self.directory, request.config, described, tracked, closed, request.map_formats, self._show_final
        )
        is_resumable = outcome.stopped is not None and unfinished is not None and (unfinished.run / STATE).is_file()
        self.outcome = replace(outcome, is_resumable=is_resumable)
        return self.outcome

    def _show_final(self, drawn: DrawnMap) -> None:
        if drawn.cloud is not None:
            self.viewer.show_final_map(drawn.cloud.points)
        self.shown.close()


@contextmanager
def open_session(
    request: R, phase: Callable[[str], None], recording: Recording | None = None
) -> Iterator[RunSession[R]]:
    """Load the odometry, which has to overlap with the recording where it is external, and lock the directory.

    After the block, everything is closed, a finished run has no checkpoint, and report and UTM files are written.
    """
    prior, resume = (request.prior, request.resume) if isinstance(request, RunRequest) else (None, False)
    with Interruptions() as interruptions:
        with ExitStack() as stack:
            compiling = stack.enter_context(CompileAhead(parts_of(request.config)))
            phase("loading the odometry")
            odometry = stack.enter_context(closing(open_odometry(request.config, prior)))
            if recording is not None and isinstance(odometry, ExternalOdometry):
                info = recording.describe()
                odometry.require_overlap(info.first_stamp, info.last_stamp)
            directory = stack.enter_context(RunDirectory.create(request.out, request.overwrite, resume))
            session = RunSession(
                request, directory, odometry, phase, interruptions=interruptions, compiling=compiling, opened=stack
            )
            with session.shown:
                yield session
        if session.outcome is None:
            return
        if session.unfinished is not None:
            session.unfinished.end(session.outcome.stopped is not None)
        if request.report:
            phase("drawing the report")
            draw_report(request.out, session.outcome)
        if session.gnss is not None:
            phase("writing the results in UTM")
            write_in_utm(request.out)


def draw_report(out: Path, outcome: RunOutcome) -> None:
    """Draw report.html and its pictures; a failure is a warning."""
    from lidarslam.evaluation.comparison.comparison import MethodResult
    from lidarslam.viewer.run_report import leave_report

    leave_report(out, MethodResult(out.name, "ok", metrics=outcome.metrics))


def write_in_utm(run: Path) -> None:
    """Write the results in UTM, too; positions that do not determine the heading are a warning."""
    from lidarslam.exports.geo import export_geo

    try:
        for line in export_geo(run, run / UTM, overwrite=True):
            logger.info(line)
    except InputError as error:
        logger.warning("not written in UTM: %s", error)


def open_odometry(config: Config, prior: Path | None) -> Odometry:
    """The configured odometry, which the caller closes; ConfigError where it does not go with the mapping."""
    method = config.odometry.method
    if (method == "constant-velocity" or config.odometry.uses_imu) and not config.mapping.enabled:
        raise ConfigError(
            f"odometry.method={method} needs scan-to-map registration, which it gives a prediction. Choose --odometry"
            " learned, give a trajectory with --prior, or a mapping with --mapping surfels or --mapping loam"
        )
    if method == "external" and prior is None:
        raise ConfigError("odometry.method=external needs a whole trajectory: give it with lidarslam run --prior FILE")
    if config.mapping.method not in MAPPINGS.built_in:
        MAPPINGS.load(config.mapping.method, Callable)  # so that nothing is written if it cannot be
    return where_needed(make_odometry(config.odometry, None if prior is None else read_tum(prior)), config)


def track(
    session: RunSession[RunRequest],
    recording: Recording,
    chosen: range,
    progress: Progress,
    graph: KeyframeGraph | None = None,
    mapper: ScanMapper | None = None,
) -> Tracked:
    """Take the chosen scans of a recording through the pipeline, which saves, logs and shows them by the session.

    A mapper replaces the one that is configured. NoScanError where no scan could be used; InputError where the run
    began with another recording.
    """
    request, log, odometry, unfinished = session.request, session.log, session.odometry, session.unfinished
    config, faults, estimator = request.config, Faults(), ElevationEstimator()
    scans = take_in(recording, chosen, faults)
    inertial = calibration.open_inertial(config, recording, chosen, log.warn)
    if inertial is not None:
        scans = map(inertial.gyroscope.evened, scans)
    checkpoints = None if unfinished is None else Checkpoints(unfinished, config.checkpoints, odometry, log, graph)
    localiser: Localiser
    if mapper is not None:
        localiser = ScanToMap(mapper, inertial)
    else:
        start = _start(config, recording, chosen, inertial)
        if start.velocity is not None and isinstance(odometry, ExpectingOdometry):
            odometry.expect(start.velocity)
        localiser = make_localiser(config, inertial, estimator, start.motions)
    store = TileStore(request.out, None if unfinished is None else unfinished.run / TILES)
    pipeline = Pipeline(odometry, localiser, config.global_map, graph, checkpoints, store)
    if checkpoints is not None:
        checkpoints.interruptions = session.interruptions
        scans = checkpoints.begin(pipeline, scans, is_recorded=request.rerun != "off")
    truth = unless_damaged(lambda: recording.ground_truth, log, "no metrics")
    with suppress(InputError):  # raised again when the scans are read
        log.warn(*recording.warnings)
    error = _process(pipeline, scans, session, truth, lambda number, result: progress(number, len(chosen), result))
    if not log.table["points"].any():
        if isinstance(error, KeyboardInterrupt):
            raise NoScanError(f"{request.source}: interrupted before a scan was done; nothing was kept", True)
        why = "; ".join(_why_none(log, faults, error))
        raise NoScanError(f"{request.source}: no scan could be used: {why}", False)
    elevation = calibration.Elevation.found(recording, estimator)
    if inertial is not None:
        log.warn(*inertial.warnings, calibration.found_imu(inertial, recording))
    if isinstance(odometry, ExternalOdometry):
        log.warn(odometry.warning, calibration.prior_warning(log.odometry, log.trajectory))
    log.warn(None if elevation is None else elevation.warning)
    if any(status is not Status.OK for status in log.statuses):
        with suppress(InputError):  # of damaged samples
            log.warn(calibration.unused_imu(config, recording))
    tracked = TrackedScans.of(log, faults, pipeline.map, len(chosen), error)
    return Tracked(tracked, pipeline.map.global_map, recording, truth, elevation)


def _start(config: Config, recording: Recording, chosen: range, inertial: "Inertial | None") -> SmoothedStart:
    """The motions of the first scans, where they have to be smoothed."""
    if config.mapping.method not in ("surfels", "loam") or len(chosen) < SHOWING:
        return SmoothedStart()
    logger.info("the first scans are registered beforehand")
    with suppress(InputError):  # raised again when the scans are read
        scans = take_in(recording, chosen, Faults())
        if inertial is None:
            return smoothed_start(scans, config.mapping)
        return smoothed_start(map(inertial.gyroscope.evened, scans), config.mapping, inertial)
    return SmoothedStart()


def _process(
    pipeline: Pipeline,
    scans: Iterable[Scan],
    session: RunSession[RunRequest],
    truth: Trajectory | None,
    progress: Callable[[int, ScanEstimate], None],
) -> InputError | KeyboardInterrupt | None:
    """Take every scan through the pipeline; the error that ended it early, or None."""
    log, finished = session.log, time.perf_counter()
    try:
        with closing(pipeline.run(prefetch(scans))) as estimates:
            for estimate in estimates:
                before, finished = finished, time.perf_counter()
                if truth is not None:
                    _show_reference(session.viewer, truth, log.stamps[0] if len(log) else estimate.stamp)
                    truth = None
                session.take(estimate, 1e3 * (finished - before), pipeline.map)
                progress(len(log), estimate)
    except (InputError, KeyboardInterrupt) as error:
        log.warn(f"stopped after {count(len(log), 'scan')}: {reason_of(error)}")
        return error.with_traceback(None)  # whose frames hold maps and scans
    return None


def _show_reference(viewer: Viewer, truth: Trajectory, first_stamp: float) -> None:
    """Show the ground truth in the run's world: they coincide at the first scan."""
    if len(truth) >= 2:
        nearest = np.clip(first_stamp, truth.stamps[0], truth.stamps[-1])
        viewer.show_reference(truth.transformed(inverse(truth.at(np.array([nearest]))[0])))


def _why_none(log: ScanLog, faults: Faults, error: InputError | None) -> Iterator[str]:
    if error is not None:
        yield str(error)
    yield from faults.warnings()
    if len(log):
        invalid = count(int(log.table["points_dropped"].sum()), "invalid point")
        expected = "NaN, at the origin, or beyond 10 km: expected are metres from the LiDAR, not from a map's origin"
        yield f"{count(len(log), 'scan')} without a valid point, {invalid} ({expected})"
