"""One run on disk from its beginning to its results: directory, odometry, pose graph, log and viewer."""

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.trajectory import read_tum
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.config import MAPPINGS
from lidarslam.mapping.global_map.drawing import DrawnMap
from lidarslam.odometry.interface import Odometry
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.compile_ahead import CompileAhead, parts_of
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.pipeline.map_building import MapBuilder
from lidarslam.pipeline.odometry_gate import where_needed
from lidarslam.run.interruption import Interruptions
from lidarslam.run.loop_closing import begin_graph, close_loops
from lidarslam.run.request import LiveRequest, RunRequest
from lidarslam.run.results import RunOutcome, Tracked, write_results
from lidarslam.run.scan_log import ScanLog
from lidarslam.storage.directory import RERUN, RunDirectory
from lidarslam.storage.unfinished import Unfinished
from lidarslam.viewer.rerun_program import require_window
from lidarslam.viewer.viewer import Viewer
from lidarslam.viewer.web_page import WebPage

if TYPE_CHECKING:  # GTSAM and SciPy take a while to load
    from lidarslam.mapping.loops.closure import GivenLoops
    from lidarslam.mapping.pose_graph.edges import ProjectedTrack
    from lidarslam.mapping.pose_graph.slam_graph import SlamGraph

logger = logging.getLogger(__name__)

# The folder of a run's results in UTM.
UTM_FOLDER = "utm"


@dataclass(eq=False)
class RunSession:
    """A run in progress; opened with `open_session`, or by itself for scans that are only tracked.

    Attributes:
        request, directory, odometry: the request, its output directory and its odometry.
        phase: called with a short text on the progress.
        unfinished: where checkpoints are saved; None: nowhere.
        graph: the pose graph; None without one.
        log, viewer: of the scans.
        outcome: once the results are written.
    """

    request: RunRequest | LiveRequest
    directory: RunDirectory
    odometry: Odometry
    phase: Callable[[str], None] = lambda _: None
    unfinished: Unfinished | None = None
    graph: "SlamGraph | None" = None
    log: ScanLog = field(default_factory=ScanLog)
    viewer: Viewer = field(default_factory=Viewer)
    outcome: RunOutcome | None = None
    interruptions: Interruptions = field(default_factory=Interruptions)
    compiling: CompileAhead | None = None
    _open: ExitStack = field(default_factory=ExitStack)  # closed with the directory
    _shown: ExitStack = field(default_factory=ExitStack)  # closed with the last that is shown

    def claim(self, description: dict[str, Any], resume: bool) -> None:
        """Save checkpoints of the run with that description, or resume it.

        Raises:
            InputError: there is nothing to resume, it is damaged, or it is another run.
        """
        self.unfinished = self._open.enter_context(Unfinished.claim(self.directory, description, resume))

    def begin_graph(self, given: "GivenLoops | None" = None, takes_gnss: bool = False) -> None:
        """Begin the pose graph, where there is one, or resume that of the checkpoint.

        Raises:
            InputError: the checkpoint is damaged.
        """
        file = None if self.unfinished is None else self.unfinished.files.submaps
        self.graph = begin_graph(self.request.config, self.directory.path, file, takes_gnss, given)
        if self.graph is not None:
            self._open.callback(self.graph.close)
            if self.unfinished is not None and self.unfinished.saved is not None:
                self.graph.restore(self.unfinished.saved.part("graph"))

    def show(self, name: str, page: WebPage | None) -> None:
        """Open the viewer; a Rerun recording that cannot be written is a warning."""
        if self.request.rerun != "off":
            self.viewer = self._shown.enter_context(self._viewing(name, page))

    @contextmanager
    def _viewing(self, name: str, page: WebPage | None) -> Iterator[Viewer]:
        from lidarslam.viewer.rerun_recording import IncompleteRecordingError
        from lidarslam.viewer.rerun_viewer import rerun_viewer

        viewer, spawn = self.request.config.viewer, self.request.rerun == "spawn"
        try:
            with self.directory.replacing(RERUN) as path, rerun_viewer(name, viewer, path, spawn, page) as shown:
                yield shown
        except IncompleteRecordingError as error:
            self.log.warn(f"no {RERUN}: {error}")

    def close_viewer(self) -> None:
        """End the viewer; a warning is added to the summary."""
        self._shown.close()

    def take(self, estimate: ScanEstimate, total_ms: float, built: MapBuilder) -> None:
        """Log and show a scan, and at intervals the map."""
        self.log.add(estimate, total_ms)
        index = len(self.log) - 1
        self.viewer.show_scan(index, estimate)
        if built.global_map is not None and self.viewer.wants_map(index):
            self.viewer.show_map(built.global_map.points())

    def wait_for_loops(self, for_first_scan: bool = False) -> None:
        """Wait until loops are compiled: all, or those that the first scan needs."""
        if self.compiling is not None:
            wait = self.compiling.wait_for_first_scan if for_first_scan else self.compiling.wait_for_all
            wait(self.phase)

    def end_scans(self) -> None:
        """From here on a request to end the run waits for the results."""
        self.interruptions.protect_results()
        self.wait_for_loops()
        self.phase("writing the results")

    def finish(self, tracked: Tracked, described: dict[str, Any], gnss: "ProjectedTrack | None" = None) -> RunOutcome:
        """Close the loops, draw the map, and write everything, after `end_scans`.

        Args:
            tracked: the scans.
            described: the description of the run, for config.yaml.
            gnss: constrains the pose graph.

        Raises:
            OutputError: a file cannot be written.
        """
        request, unfinished = self.request, self.unfinished
        closed = close_loops(self.graph, tracked.global_map, self.log, self.viewer, gnss)
        outcome = write_results(
            self.directory, request.config, described, tracked, closed, request.map_formats, self._show_final
        )
        is_resumable = outcome.stopped is not None and unfinished is not None and unfinished.files.state.is_file()
        self.outcome = replace(outcome, is_resumable=is_resumable)
        return self.outcome

    def _show_final(self, drawn: DrawnMap) -> None:
        if drawn.cloud is not None:
            self.viewer.show_final_map(drawn.cloud.points)
        self.close_viewer()

    def conclude(self) -> None:
        """Once the directory is closed: leave no checkpoint of a finished run, and draw the report."""
        if self.outcome is None:
            return
        if self.unfinished is not None:
            self.unfinished.end(self.outcome.stopped is not None)
        if self.request.report:
            draw_report(self.request.out, self.outcome, self.phase)


@contextmanager
def open_session(
    request: RunRequest | LiveRequest,
    phase: Callable[[str], None],
    recording: Recording | None = None,
    is_placed: bool = False,
) -> Iterator[RunSession]:
    """Load the odometry and lock the directory; after the block, everything is closed and the report is drawn.

    Args:
        request: the run to execute.
        phase: called with a short text on the progress.
        recording: its source, which an external odometry has to overlap with.
        is_placed: whether the results are written in UTM as well.

    Raises:
        LidarSlamError: the configuration or the directory is not usable.
    """
    if request.rerun == "spawn":
        require_window("serve a browser with --rerun web, or write a file with --rerun save")
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
            session = RunSession(request, directory, odometry, phase, interruptions=interruptions, compiling=compiling)
            stack.push(session._open)
            stack.push(session._shown)
            yield session
        session.conclude()
        if is_placed:
            phase("writing the results in UTM")
            write_in_utm(request.out)


def draw_report(out: Path, outcome: RunOutcome, phase: Callable[[str], None] = lambda _: None) -> None:
    """Draw report.html and its pictures; a failure is a warning."""
    from lidarslam.evaluation.comparison.comparison import MethodResult
    from lidarslam.viewer.run_report import leave_report

    phase("drawing the report")
    leave_report(out, MethodResult(out.name, "ok", metrics=outcome.metrics))


def write_in_utm(run: Path) -> None:
    """Write map and trajectory of a finished run in UTM, in a folder of its own; see `lidarslam.exports.geo`.

    Positions that do not determine the heading are a warning only: the run is written already.

    Raises:
        OutputError: a file cannot be written.
    """
    from lidarslam.exports.geo import export_geo, georeference

    try:
        for line in export_geo(georeference(run), run / UTM_FOLDER, overwrite=True):
            logger.info(line)
    except InputError as error:
        logger.warning("not written in UTM: %s", error)


def require_apart(out: Path, source: Path) -> None:
    """Refuse to write into a recording; OutputError where `out` is the source."""
    if out.resolve() == source.resolve():
        raise OutputError(f"{out}: is the recording itself; name another directory for the run")


def require_no_trajectory(config: Config) -> None:
    """Refuse an odometry that needs more of a recording than its scans one by one.

    Raises:
        ConfigError: it needs a trajectory.
    """
    if config.odometry.method == "external":
        raise ConfigError("odometry.method=external needs a whole trajectory beforehand: use lidarslam run --prior")


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
    return where_needed(make_odometry(config.odometry, None if prior is None else read_tum(prior)), config)
