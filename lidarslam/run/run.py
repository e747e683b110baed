"""One run on disk: from a source to a run directory."""

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lidarslam.config.settings import Config, ViewerConfig
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.trajectory import read_tum
from lidarslam.datasets.intake import choose_scans
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.config import MAPPINGS
from lidarslam.odometry.interface import Odometry, SkippingOdometry
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.compile_ahead import CompileAhead, parts_of
from lidarslam.pipeline.odometry_gate import OdometryGate
from lidarslam.run.checkpoints import describe_computed
from lidarslam.run.elevation import with_elevations
from lidarslam.run.inertial import imu_samples
from lidarslam.run.interruption import Interruptions
from lidarslam.run.loop_closing import begin_graph, close_loops, restore_graph
from lidarslam.run.request import RunRequest, describe_run, log_choices
from lidarslam.run.results import RunOutcome, final_map, write_results
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.tracking import Progress, track
from lidarslam.storage.directory import RERUN, RunDirectory
from lidarslam.storage.unfinished import Unfinished
from lidarslam.viewer.rerun_program import require_window
from lidarslam.viewer.viewer import RerunMode, Viewer
from lidarslam.viewer.web_page import WebPage

if TYPE_CHECKING:  # loads SciPy and the pose graph
    from lidarslam.mapping.pose_graph.edges import ProjectedTrack
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph

logger = logging.getLogger(__name__)

# The folder of a run's results in UTM.
UTM_FOLDER = "utm"


def gnss_track(request: RunRequest) -> "ProjectedTrack | None":
    """The GNSS track of a recording, in UTM; None where the pose graph uses none.

    Raises:
        InputError: the recording has no GNSS positions.
        ConfigError: pyproj is not installed.
    """
    if not (request.config.pose_graph.enabled and request.config.pose_graph.gnss):
        return None
    from lidarslam.exports.geo import read_gnss, utm_around
    from lidarslam.mapping.pose_graph.edges import ProjectedTrack

    track = read_gnss(request.source, request.config.reader)
    utm = utm_around(track.geodetic)
    return ProjectedTrack(track, utm.project(track.geodetic), utm.scale)


def write_in_utm(request: RunRequest) -> None:
    """Write map and trajectory of a finished run in UTM, in a folder of its own; see `lidarslam.exports.geo`.

    Positions that do not determine the heading are a warning: the run is there.

    Raises:
        OutputError: a file cannot be written.
    """
    from lidarslam.exports.geo import export_geo, georeference

    try:
        for line in export_geo(georeference(request.out), request.out / UTM_FOLDER, overwrite=True):
            logger.info(line)
    except InputError as error:
        logger.warning("not written in UTM: %s", error)


def execute(
    request: RunRequest,
    progress: Progress,
    phase: Callable[[str], None] = lambda _: None,
    page: WebPage | None = None,
) -> RunOutcome:
    """Run, and write the run directory.

    A damaged recording or an interruption ends the run early, with the results so far. A run that is killed can be
    resumed, to the same results.

    Args:
        request: what is run.
        progress: called after every scan.
        phase: called with a few words on what goes on before the first scan and after the last.
        page: shows the run in browsers, with `rerun="web"`.

    Raises:
        LidarSlamError: the source, the configuration or the output directory is not usable, or there is nothing to
            resume.
    """
    require_apart(request.out, request.source)
    if request.rerun == "spawn":
        require_window("serve a browser with --rerun web, or write a file with --rerun save")
    config = request.config
    phase("opening the recording")
    recording = open_recording(request.source, config.reader)
    chosen = _choose(request, recording)
    log_choices(request, chosen, len(recording))
    imu_samples(config, recording)
    track_of_gnss = gnss_track(request)
    with Interruptions() as interruptions:
        with ExitStack() as stack:
            compiling = stack.enter_context(CompileAhead(parts_of(config)))
            phase("loading the odometry")
            odometry = require_overlap(open_odometry(config, request.prior), recording)
            stack.callback(odometry.close)
            directory = stack.enter_context(RunDirectory.create(request.out, request.overwrite, request.resume))
            unfinished = None
            if request.resumable:
                description = describe_computed(request, recording)
                unfinished = stack.enter_context(Unfinished.claim(directory, description, request.resume))
            log, graph = ScanLog(), _open_graph(request, directory, unfinished)
            if config.mapping.budget_ms is not None:
                log.warn("with mapping.budget_ms the results depend on the clock; another run may differ")
            if graph is not None:
                stack.callback(graph.close)
            with viewing(request.rerun, config.viewer, recording.name, directory, log, page) as viewer:
                compiling.wait_for_first_scan(phase)
                request, recording = with_elevations(request, recording, chosen, phase)
                phase("reading the first scans")
                tracked = track(request, recording, chosen, odometry, log, graph, viewer, progress, unfinished)
                interruptions.protect_results()
                compiling.wait_for_all(phase)
                phase("writing the results")
                closed = close_loops(graph, tracked.global_map, log, viewer, track_of_gnss)
                drawn = final_map(tracked, closed, config.global_map, directory)
                if drawn.cloud is not None:
                    viewer.show_final_map(drawn.cloud.points)
            formats = request.map_formats
            outcome = write_results(directory, request.config, describe_run(request), tracked, closed, drawn, formats)
        if unfinished is not None:
            unfinished.end(outcome.stopped is not None)
            is_resumable = outcome.stopped is not None and unfinished.files.state.is_file()
            outcome = replace(outcome, is_resumable=is_resumable)
        if request.report:
            _draw_report(request, outcome, phase)
        if track_of_gnss is not None:
            phase("writing the results in UTM")
            write_in_utm(request)
    return outcome


def _draw_report(request: RunRequest, outcome: RunOutcome, phase: Callable[[str], None]) -> None:
    from lidarslam.viewer.run_report import Accuracy, leave_report

    phase("drawing the report")
    leave_report(request.out, Accuracy(outcome.metrics))


def _choose(request: RunRequest, recording: Recording) -> range:
    """The scans of a run.

    Raises:
        InputError: there are none, or not those of a loop closure that is given or forbidden.
    """
    chosen = choose_scans(recording, request.source, request.start, request.stop, request.step)
    scans = len(chosen)
    for option, pairs in (("--loop", request.given.closed), ("--no-loop", request.given.forbidden)):
        for first, second in pairs:
            if second >= scans:
                raise InputError(f"{option} {first} {second}: the run has {scans} scans, from 0 to {scans - 1}")
    return chosen


def _open_graph(request: RunRequest, directory: RunDirectory, unfinished: Unfinished | None) -> "SlamGraph | None":
    """The pose graph, if there is one: new, or as it was saved.

    Raises:
        InputError: the checkpoint is damaged.
    """
    config, given = request.config, request.given
    if unfinished is None:
        return begin_graph(config, directory.path, takes_gnss=True, given=given)
    saved, file = unfinished.saved, unfinished.files.submaps
    if saved is None:
        return begin_graph(config, file=file, takes_gnss=True, given=given)
    return restore_graph(config, saved.part("graph"), file, given) if saved.has("graph") else None


@contextmanager
def viewing(
    mode: RerunMode, config: ViewerConfig, name: str, directory: RunDirectory, log: ScanLog, page: WebPage | None
) -> Iterator[Viewer]:
    """The viewer of a run; a Rerun recording that cannot be written is a warning."""
    if mode == "off":
        yield Viewer()
        return
    from lidarslam.viewer.rerun_recording import IncompleteRecordingError
    from lidarslam.viewer.rerun_viewer import rerun_viewer

    try:
        with (
            directory.replacing(RERUN) as path,
            rerun_viewer(name, config, path, mode == "spawn", page) as viewer,
        ):
            yield viewer
    except IncompleteRecordingError as error:
        log.warn(f"no {RERUN}: {error}")


def require_apart(out: Path, source: Path) -> None:
    """Refuse to write into a recording.

    Raises:
        OutputError: `out` is the source.
    """
    if out.resolve() == source.resolve():
        raise OutputError(f"{out}: is the recording itself; name another directory for the run")


def open_odometry(config: Config, prior: Path | None) -> Odometry:
    """The configured odometry; the caller closes it.

    Raises:
        LidarSlamError: the configuration contradicts itself, a file is damaged, or a plug-in cannot be loaded.
    """
    method = config.odometry.method
    if method == "constant-velocity" and not config.mapping.enabled:
        raise ConfigError(
            "constant-velocity only predicts the motion, and needs scan-to-map registration. Choose --odometry learned,"
            " give a trajectory with --prior, or a mapping with --mapping surfels or --mapping loam"
        )
    if config.odometry.uses_imu and not config.mapping.enabled:
        raise ConfigError(
            f"{method}: the IMU takes part in scan-to-map registration. Choose --odometry learned, or a mapping with"
            " --mapping surfels or --mapping loam"
        )
    if method == "external" and prior is None:
        raise ConfigError("odometry.method is external: give its trajectory with --prior FILE")
    if config.mapping.method not in MAPPINGS.built_in:
        MAPPINGS.load(config.mapping.method, Callable)  # so that nothing is written if it cannot be
    odometry = make_odometry(config.odometry, None if prior is None else read_tum(prior))
    if config.odometry.learned.when == "always" or not config.mapping.enabled:
        return odometry
    return OdometryGate(odometry) if isinstance(odometry, SkippingOdometry) else odometry


def require_overlap(odometry: Odometry, recording: Recording) -> Odometry:
    """The odometry, unless it is a prior of another time.

    Raises:
        InputError: it has no pose while the recording lasts.
    """
    if isinstance(odometry, ExternalOdometry):
        described = recording.describe()
        odometry.require_overlap(described.first_stamp, described.last_stamp)
    return odometry


def require_no_trajectory(config: Config) -> None:
    """Refuse an odometry that takes more of a recording than what comes one after the other.

    Raises:
        ConfigError: it needs a trajectory.
    """
    if config.odometry.method == "external":
        raise ConfigError("odometry.method=external needs a whole trajectory beforehand: use lidarslam run --prior")
