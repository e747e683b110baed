"""Runs in Rerun; the only file that imports it."""

import contextlib
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evaluation.map.metrics import CloudErrors, MapComparison
from evaluation.report.error_colours import error_colours
from lidarslam.config.settings import ViewerConfig
from lidarslam.core.errors import OutputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline.estimates import STAGES, ScanResult
from lidarslam.run.directory import RunDirectory
from lidarslam.run.finished_run import FinishedRun
from lidarslam.viewer import rerun_environment
from lidarslam.viewer.picture import height_colours
from lidarslam.viewer.rerun_file import PipedFile
from lidarslam.viewer.rerun_program import LOCAL, is_taken, open_window, serve_page

_log = logging.getLogger(__name__)

# How a complete .rrd file of this version ends, before the four bytes of its flags.
_FOOTER, _FLAG_BYTES = b"RRF2FOOT", 4
# A writer that died would otherwise be waited for without end.
_FLUSH_S = 20.0
# What there is to write was flushed by then.
_DISCONNECT_S = 10.0

_SCAN_TIMELINE = "scan"
_TIME_TIMELINE = "time"
# Where Rerun listens unless told otherwise, and what says that Linux has a display.
_GRPC_PORT, _WEB_PORT = 9876, 9090
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")

# Okabe and Ito's palette, distinguishable under every common colour blindness.
_STATUS_COLOURS = {Status.OK: (0, 114, 178), Status.DEGRADED: (230, 159, 0), Status.LOST: (213, 94, 0)}
_REFERENCE_COLOUR = (0, 158, 115)
_SCAN_COLOUR = (240, 228, 66)
_CLOSED_COLOUR = (86, 180, 233)
_LOOP_COLOUR = (204, 121, 167)
_RUN_COLOURS = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0))
# While a run is at work, the map is shown this far around the sensor.
_NEAR_M = 60.0
# Negative radii are in points on the screen, whatever the zoom.
_PATH_RADIUS, _SCAN_RADIUS, _MAP_RADIUS = -3.0, -1.5, -1.0
# Entity, title, and the names of its series.
_PLOTS = (
    ("ms", "ms per scan", STAGES),
    ("residual", "Residual [m]", ("median point to plane",)),
    ("inliers", "Inlier ratio", ("worst direction",)),
)


class IncompleteRecordingError(OutputError):
    """A Rerun recording came out cut off."""


def require_complete(path: Path) -> None:
    """See that a recording was written to its end; Rerun's writer only logs that the disk is full.

    Raises:
        IncompleteRecordingError: it was not.
    """
    footer = b""
    with contextlib.suppress(OSError), path.open("rb") as file:
        file.seek(-len(_FOOTER) - _FLAG_BYTES, os.SEEK_END)
        footer = file.read(len(_FOOTER))
    if footer != _FOOTER:
        raise IncompleteRecordingError("the Rerun recording could not be written to its end; is the disk full?")


class RerunViewer:
    """Logs a run to a file, to a window, or both.

    Args:
        name: shown as the recording's name.
        config: how much is shown.
        save: the .rrd file to write, or None.
        spawn: whether to open a window.

    Raises:
        OutputError: the window cannot be opened, or the recording cannot be begun.
    """

    def __init__(self, name: str, config: ViewerConfig, save: Path | None = None, spawn: bool = False) -> None:
        self._config = config
        self._recording = rr.RecordingStream("lidarslam")
        self._last_position: FloatArray | None = None
        if spawn:
            open_window(_GRPC_PORT)
        self._file = None if save is None else PipedFile(save)
        try:
            _send_to(self._recording, self._file, [rr.GrpcSink()] if spawn else [], _blueprint())
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise OutputError(f"the Rerun recording cannot be begun ({reason}); leave --rerun out") from error
        self._recording.send_recording_name(name)
        self._log_static()

    def wants_map(self, index: int) -> bool:
        """Every so many scans."""
        return index % self._config.map_every == 0

    def show_reference(self, reference: Trajectory) -> None:
        """The whole true path, at once."""
        path = rr.LineStrips3D([reference.positions], colors=[_REFERENCE_COLOUR], labels=["ground truth"])
        self._recording.log("world/ground_truth", path, static=True)

    def show_scan(self, index: int, result: ScanResult) -> None:
        """The scan at its pose, one more piece of the trajectory, one more value in every plot."""
        self._recording.set_time(_SCAN_TIMELINE, sequence=index)
        self._recording.set_time(_TIME_TIMELINE, timestamp=result.stamp)
        T = result.T_world_lidar
        self._recording.log("world/lidar", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        points = _every_nth(result.points, self._config.scan_points)
        self._recording.log("world/lidar/scan", rr.Points3D(points, colors=[_SCAN_COLOUR], radii=_SCAN_RADIUS))
        self._log_path(T[:3, 3], result.status)
        self._recording.log("plots/ms", rr.Scalars([result.stage_ms.get(stage, 0.0) for stage in STAGES]))
        for plot, value in (("residual", result.residual_m), ("inliers", result.inlier_ratio)):
            if value is not None:
                self._recording.log(f"plots/{plot}", rr.Scalars(value))
        if result.message:
            level = rr.TextLogLevel.ERROR if result.status is Status.LOST else rr.TextLogLevel.WARN
            self._recording.log("log", rr.TextLog(result.message, level=level))

    def show_map(self, points: FloatArray) -> None:
        """The part of the map around the sensor, coloured by height."""
        if self._last_position is not None:
            near = np.linalg.norm(points - self._last_position, axis=1) < _NEAR_M
            points = points[near]
        self.show_final_map(points)

    def show_final_map(self, points: FloatArray) -> None:
        """All of the map, coloured by height."""
        points = _every_nth(points, self._config.map_points)
        cloud = rr.Points3D(points, colors=height_colours(points), radii=_MAP_RADIUS)
        self._recording.log("world/map", cloud)

    def show_closed(self, positions: FloatArray, loops: Sequence[tuple[int, int]]) -> None:
        """The corrected path beside the one that was seen to grow, and the loops."""
        path = rr.LineStrips3D([positions], colors=[_CLOSED_COLOUR], radii=_PATH_RADIUS, labels=["loops closed"])
        self._recording.log("world/closed/trajectory", path)
        self._recording.log("world/closed/loops", _loop_lines(positions, np.array(loops, dtype=np.intp).reshape(-1, 2)))

    def close(self) -> None:
        """Wait until everything is written; a window that went away does not fail the run."""
        try:
            self._recording.flush(timeout_sec=_FLUSH_S)
        except RuntimeError as error:
            _log.info("Rerun: %s", str(error).strip().splitlines()[0])
            rerun_environment.abandoned = True
        _disconnect(self._recording, self._file)

    def _log_static(self) -> None:
        self._recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for plot, _, names in _PLOTS:
            self._recording.log(f"plots/{plot}", rr.SeriesLines(names=names), static=True)

    def _log_path(self, position: FloatArray, status: Status) -> None:
        """Only the newest piece: the view shows all pieces up to the present, so the recording grows linearly."""
        if self._last_position is not None:
            piece = rr.LineStrips3D(
                [np.stack([self._last_position, position])], colors=[_STATUS_COLOURS[status]], radii=_PATH_RADIUS
            )
            self._recording.log("world/trajectory", piece)
        self._last_position = position.copy()


def _send_to(
    recording: rr.RecordingStream,
    file: PipedFile | None,
    sinks: Sequence[rr.GrpcSink | rr.GrpcServerSink],
    blueprint: rrb.Blueprint | None = None,
) -> None:
    """Send a recording into a file and wherever else; the file is finished when that fails."""
    files = [] if file is None else [rr.FileSink(file.entrance)]
    try:
        recording.set_sinks(*files, *sinks, default_blueprint=blueprint)
    except BaseException:
        if file is not None:
            file.finish()
        raise
    if file is not None:
        file.let_go()


def _disconnect(recording: rr.RecordingStream, file: PipedFile | None) -> None:
    """Let the sinks be closed; one that never ends is left to itself after a while."""
    thread = threading.Thread(target=recording.disconnect, name="disconnect", daemon=True)
    thread.start()
    thread.join(_DISCONNECT_S)
    if thread.is_alive() or not (file is None or file.finish()):
        rerun_environment.abandoned = True


def _blueprint() -> rrb.Blueprint:
    """A 3D view beside time series, with the panels that newcomers do not need folded."""
    whole_past = [
        rrb.VisibleTimeRange(
            timeline, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
        )
        for timeline in (_SCAN_TIMELINE, _TIME_TIMELINE)
    ]
    space = rrb.Spatial3DView(
        origin="/world",
        name="Trajectory and map",
        overrides={"world/trajectory": [rrb.VisibleTimeRanges(whole_past)]},
    )
    plots = [rrb.TimeSeriesView(origin=f"/plots/{plot}", name=title) for plot, title, _ in _PLOTS]
    return rrb.Blueprint(
        rrb.Horizontal(
            space, rrb.Vertical(*plots, rrb.TextLogView(origin="/log", name="Messages")), column_shares=[3, 1]
        ),
        rrb.TimePanel(timeline=_SCAN_TIMELINE, state="collapsed"),
        collapse_panels=True,
    )


def _loop_lines(positions: FloatArray, loops: NDArray[np.intp]) -> rr.LineStrips3D:
    """A line from scan to scan for each of the loops (L, 2)."""
    return rr.LineStrips3D(list(positions[loops]), colors=[_LOOP_COLOUR], radii=_PATH_RADIUS)


def _every_nth(points: FloatArray, count: int) -> FloatArray:
    return points[:: max(1, -(-len(points) // count))]


@dataclass(frozen=True, eq=False)
class Served:
    """What a browser is served as long as this is held.

    Attributes:
        address: for the browser.
    """

    address: str
    recording: rr.RecordingStream
    page: "subprocess.Popen[bytes]"


def show_runs(runs: Sequence[FinishedRun], config: ViewerConfig, save: Path | None, web: bool) -> Served | None:
    """Finished runs in one view: trajectories, maps, and where tracking was lost.

    Args:
        runs: what to show; each gets an entity of its own.
        config: how much is shown.
        save: the .rrd file to write, instead of a window.
        web: serve a browser on this machine, instead of a window.

    Returns:
        What the browser is served, if one is.

    Raises:
        OutputError: the file cannot be written, the window cannot be opened or the browser cannot be served.
    """
    recording = rr.RecordingStream("lidarslam")
    served = None
    try:
        with _recording_file(save) as path:
            file = None if path is None else PipedFile(path)
            _send_to(recording, file, [] if file is not None else [_local_server() if web else _window()])
            recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            for number, run in enumerate(runs):
                _log_run(recording, ["world", f"{number}_{run.name}"], run, number, config)
            recording.flush(timeout_sec=_FLUSH_S)
            if path is not None:
                _disconnect(recording, file)
                require_complete(path)
            elif web:
                server = f"rerun+http://{LOCAL}:{_GRPC_PORT}/proxy"
                address = f"http://{LOCAL}:{_WEB_PORT}/?url={quote(server, safe='')}"
                served = Served(address, recording, serve_page(_WEB_PORT, server))
    except (RuntimeError, OSError, IncompleteRecordingError) as error:
        rerun_environment.abandoned = True
        reason = " ".join(str(error).split())
        if save is not None:
            message = f"{save}: cannot be written ({reason}); name a file in a folder that exists and can be written to"
        elif web:
            message = f"the browser cannot be served ({reason}); write a file with --save FILE.rrd instead"
        else:
            message = f"the Rerun window cannot be reached ({reason}); write a file with --save FILE.rrd, or use --web"
        raise OutputError(message) from error
    return served


@contextlib.contextmanager
def _recording_file(save: Path | None) -> Iterator[Path | None]:
    """Where a recording is written until it is whole."""
    if save is None:
        yield None
        return
    with RunDirectory(save.parent).replacing(save.name) as file:
        yield file


def _local_server() -> rr.GrpcServerSink:
    """Where a browser on this machine finds the recording.

    Raises:
        OutputError: somebody else serves there.
    """
    for port in (_GRPC_PORT, _WEB_PORT):
        if is_taken(port):
            raise OutputError(
                f"port {port} is in use; close the Rerun viewer or the lidarslam view --web that has it,"
                " or write a file with --save FILE.rrd"
            )
    return rr.GrpcServerSink(bind_ip=LOCAL, port=_GRPC_PORT)


def _window() -> rr.GrpcSink:
    """The viewer, opened unless it is.

    Raises:
        OutputError: there is no display for it, or it cannot be opened.
    """
    # A viewer that runs already, perhaps at the other end of a tunnel, needs no display here.
    if sys.platform == "linux" and not any(map(os.environ.get, _DISPLAYS)) and not is_taken(_GRPC_PORT):
        raise OutputError("no display to open a window on; write a file with --save FILE.rrd, or use --web")
    open_window(_GRPC_PORT)
    return rr.GrpcSink()


def _log_run(
    recording: rr.RecordingStream, entity: list[object], run: FinishedRun, number: int, config: ViewerConfig
) -> None:
    colour = _RUN_COLOURS[number % len(_RUN_COLOURS)]
    positions = run.trajectory.positions
    path = rr.LineStrips3D([positions], colors=[colour], radii=_PATH_RADIUS, labels=[run.name])
    recording.log([*entity, "trajectory"], path, static=True)
    lost = rr.Points3D(positions[run.lost], colors=[_STATUS_COLOURS[Status.LOST]], radii=2.0 * _PATH_RADIUS)
    recording.log([*entity, "lost"], lost, static=True)
    if len(run.loops):
        recording.log([*entity, "loops"], _loop_lines(positions, run.loops), static=True)
    points = _every_nth(run.map_points, config.map_points)
    cloud = rr.Points3D(points, colors=height_colours(points), radii=_MAP_RADIUS)
    recording.log([*entity, "map"], cloud, static=True)


def save_errors(path: Path, comparison: MapComparison, positions: FloatArray | None, clip_m: float) -> None:
    """Write a recording of a map coloured by its distance to the reference, and of the reference by that to the map.

    Args:
        path: the .rrd file.
        comparison: what is shown; about its middle, because the viewer counts in single precision.
        positions: (K, 3) where the sensor was, in the reference's frame.
        clip_m: the distance of the brightest colour.

    Raises:
        OutputError: the file cannot be written.
    """
    recording = rr.RecordingStream("lidarslam")
    points = comparison.reference_errors.points
    middle = np.round(points.mean(axis=0)) if len(points) else np.zeros(3)
    try:
        file = PipedFile(path)
        _send_to(recording, file, [])
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _log_errors(recording, "world/map_to_reference", comparison.map_errors, middle, clip_m)
        _log_errors(recording, "world/reference_to_map", comparison.reference_errors, middle, clip_m)
        if positions is not None:
            line = rr.LineStrips3D([positions - middle], colors=[_REFERENCE_COLOUR], radii=_PATH_RADIUS)
            recording.log("world/path", line, static=True)
        text = f"dark: 0 m, bright: {clip_m:g} m and more; the origin is at {', '.join(f'{m:.0f}' for m in middle)}"
        recording.log("legend", rr.TextDocument(text), static=True)
        recording.send_blueprint(_errors_blueprint())
        recording.flush(timeout_sec=_FLUSH_S)
        _disconnect(recording, file)
        require_complete(path)
    except (RuntimeError, OSError, IncompleteRecordingError) as error:
        rerun_environment.abandoned = True
        raise OutputError(f"{path}: cannot be written ({' '.join(str(error).split())})") from error


def _log_errors(
    recording: rr.RecordingStream, entity: str, errors: CloudErrors, middle: FloatArray, clip_m: float
) -> None:
    colours = error_colours(errors.distances_m, clip_m)
    recording.log(entity, rr.Points3D(errors.points - middle, colors=colours, radii=_MAP_RADIUS), static=True)


def _errors_blueprint() -> rrb.Blueprint:
    """The map's errors beside the reference's, moved by hand alike."""
    views = [
        rrb.Spatial3DView(origin="/world", name=title, contents=["/world/path", f"/world/{entity}"])
        for title, entity in (("Map: how far from the reference", "map_to_reference"),
                              ("Reference: how far from the map", "reference_to_map"))
    ]  # fmt: skip
    legend = rrb.TextDocumentView(origin="/legend", name="Colours")
    return rrb.Blueprint(rrb.Vertical(rrb.Horizontal(*views), legend, row_shares=[8, 1]), collapse_panels=True)
