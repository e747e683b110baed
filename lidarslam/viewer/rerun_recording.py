"""Rerun recordings: to a file, a window or both; the colours, sizes and timelines they share.

Rerun 0.41 waits without end for a file on a full disk. Its file writer is therefore given a pipe, and the file is
written here; on failure it is emptied, which frees its space, and the rest of the pipe is discarded.
"""

import contextlib
import logging
import os
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from lidarslam.config.settings import ViewerConfig
from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import cannot_write, replacing
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.text import one_line
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.report.drawing import viridis
from lidarslam.pipeline.estimates import STAGES, ScanEstimate
from lidarslam.viewer import rerun_environment
from lidarslam.viewer.rerun_program import GRPC_PORT, WebPage, open_window, require_window
from lidarslam.viewer.view import levels
from lidarslam.viewer.viewer import Viewer

_log = logging.getLogger(__name__)

# The end of a complete .rrd file of this version, before the four bytes of its flags.
_FOOTER, _FLAG_BYTES = b"RRF2FOOT", 4
# Timeouts against a writer that died; hardly anything remains to be written by then.
_FLUSH_S, _DISCONNECT_S, _PIPE_S = 20.0, 10.0, 60.0
# Where an open file of this process has a path, and how much is written at a time.
_OPEN_FILES = Path("/dev/fd")
_PIECE = 1 << 20

# Okabe and Ito's palette, distinguishable under every common colour blindness.
STATUS_COLOURS = {Status.OK: (0, 114, 178), Status.DEGRADED: (230, 159, 0), Status.LOST: (213, 94, 0)}
REFERENCE_COLOUR = (0, 158, 115)
# Ours are chosen for a dark ground; the viewer's own may be light.
BACKGROUND = (13, 16, 17)
_DARK_TO_BRIGHT = (0.3, 1.0)
# Names of the timelines: the stamps of the scans, and their numbers.
TIME, SCAN = "time", "scan"
# Stamps below, three years after 1970, count from the beginning of the recording.
_FIRST_DATE_S = 1e8
# Negative radii are in points on the screen, whatever the zoom.
PATH_RADIUS, SCAN_RADIUS, MAP_RADIUS = -3.0, -1.5, -1.0
_INSTEAD = "write a file with --save FILE.rrd, or use --web"
_MAGIC = b"RRF2"


class IncompleteRecordingError(OutputError):
    """A Rerun recording was not written to its end."""


@contextlib.contextmanager
def rerun_recording(
    name: str, path: Path | None, window: rr.GrpcSink | None = None, blueprint: rrb.Blueprint | None = None
) -> Iterator[rr.RecordingStream]:
    """A recording that goes to a file, to a window or both, with a name and layout; written when the block ends."""
    recording = rr.RecordingStream("lidarslam")
    file = None if path is None else _PipedFile(path)
    try:
        files = [] if file is None else [rr.FileSink(file.entrance)]
        windows = [] if window is None else [window]
        try:
            recording.set_sinks(*files, *windows)
        except RuntimeError as error:
            raise OutputError(f"the Rerun recording cannot be begun ({one_line(str(error))})") from error
        finally:
            if file is not None:
                file.close_entrance()
        if blueprint is not None:  # active at once, in place of that of an earlier recording in the same window
            recording.send_blueprint(blueprint)
        recording.send_recording_name(name)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        yield recording
        try:
            recording.flush(timeout_sec=_FLUSH_S)
        except RuntimeError as error:  # a window that went away; whether the file is complete is checked below
            _log.info("Rerun: %s", one_line(str(error)))
            rerun_environment.abandoned = True
    finally:
        _disconnect(recording, file)
    if path is not None:
        require_complete(path)


def require_complete(path: Path) -> None:
    """Check that a recording was written to its end."""
    footer = b""
    with contextlib.suppress(OSError), path.open("rb") as file:
        file.seek(-len(_FOOTER) - _FLAG_BYTES, os.SEEK_END)
        footer = file.read(len(_FOOTER))
    if footer != _FOOTER:
        raise IncompleteRecordingError("the Rerun recording was not written to its end; is the disk full?")


@dataclass(frozen=True)
class Show:
    """Something to show."""

    name: str  # as the viewer lists it
    blueprint: rrb.Blueprint  # the layout of the viewer
    log: Callable[[rr.RecordingStream], None]  # writes it to a recording


def save(show: Show, path: Path) -> None:
    """Write a .rrd file."""
    try:
        with replacing(path) as partial, rerun_recording(show.name, partial, blueprint=show.blueprint) as recording:
            show.log(recording)
    except (OSError, IncompleteRecordingError) as error:
        raise cannot_write(path, error, "; name another file") from error


def show_in_window(show: Show) -> None:
    """Show it in a window."""
    require_window(_INSTEAD)
    open_window(GRPC_PORT)
    with rerun_recording(show.name, None, rr.GrpcSink(), show.blueprint) as recording:
        show.log(recording)
        try:
            recording.flush(timeout_sec=_FLUSH_S)
        except RuntimeError as error:
            rerun_environment.abandoned = True
            raise OutputError(f"the Rerun window cannot be reached ({one_line(str(error))}); {_INSTEAD}") from error


def show_on_page(show: Show, page: WebPage) -> None:
    """Show it in a browser; it is in a temporary file without a name, removed with the program."""
    with tempfile.TemporaryFile() as file:
        path = _OPEN_FILES / str(file.fileno())
        try:
            with page.showing(path), rerun_recording(show.name, path, blueprint=show.blueprint) as recording:
                show.log(recording)
        except (OSError, IncompleteRecordingError) as error:
            raise cannot_write(Path(tempfile.gettempdir()), error, f"; {_INSTEAD}") from error


def show_file_in_window(path: Path) -> None:
    """Show a .rrd file in a window."""
    _require_recording(path)
    require_window("use --web")
    open_window(GRPC_PORT, path)


def show_file_on_page(path: Path, page: WebPage) -> None:
    """Show a .rrd file in a browser."""
    _require_recording(path)
    with page.showing(path):
        pass


def _require_recording(path: Path) -> None:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise InputError(f"{path}: not a Rerun recording, or of a version before 0.20; make it again")
        require_complete(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except IncompleteRecordingError:
        raise InputError(f"{path}: is cut off, or of an earlier version of Rerun; make it again") from None


def log_map(
    recording: rr.RecordingStream,
    entity: str,
    points: FloatArray,
    count: int,
    colour: tuple[int, int, int] | None = None,
    static: bool = False,
) -> None:
    """A cloud (N, 3), thinned to so many points, coloured by height, or with a colour of that brightness."""
    points = every_nth(points, count)
    height = levels(points[:, 2])
    if colour is None:
        colours = viridis(height)
    else:
        shades = np.interp(height, [0.0, 1.0], _DARK_TO_BRIGHT)[:, None] * np.array(colour)
        colours = shades.astype(np.uint8)
    recording.log(entity, rr.Points3D(points, colors=colours, radii=MAP_RADIUS), static=static)


def true_path(truth: Trajectory) -> rr.LineStrips3D:
    """The line of the ground truth."""
    return rr.LineStrips3D([truth.positions], colors=[REFERENCE_COLOUR], labels=["ground truth"])


def about_its_start(truth: Trajectory, least: int) -> Trajectory | None:
    """In the world of its first pose, as the viewer counts in single precision; None of fewer than `least` poses."""
    return truth.transformed(inverse(truth.T_world_lidar[0])) if len(truth) >= least else None


def set_stamp(recording: rr.RecordingStream, index: int, stamp: float) -> None:
    """Set the time of the next logged data: that of the scan with this number."""
    recording.set_time(SCAN, sequence=index)
    recording.set_time(TIME, **{_time_kind(stamp): stamp})


def stamp_column(stamps: FloatArray) -> rr.TimeColumn:
    """The times of several rows that are sent at once."""
    return rr.TimeColumn(TIME, **{_time_kind(stamps[0]): stamps})


def whole_past() -> list[rr.VisibleTimeRange]:
    """For entities whose pieces stay visible, on whichever timeline."""
    start, end = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.cursor_relative()
    return [rr.VisibleTimeRange(timeline, start=start, end=end) for timeline in (SCAN, TIME)]


def _time_kind(stamp: float) -> Any:
    return "timestamp" if stamp >= _FIRST_DATE_S else "duration"


def every_nth(rows: NDArray[Any], count: int) -> NDArray[Any]:
    """At most `count` of the rows."""
    return rows[:: max(1, -(-len(rows) // count))]


def _disconnect(recording: rr.RecordingStream, file: "_PipedFile | None") -> None:
    """Close the sinks; one that does not close in time is abandoned."""
    thread = threading.Thread(target=recording.disconnect, name="disconnect", daemon=True)
    thread.start()
    thread.join(_DISCONNECT_S)
    if thread.is_alive() or not (file is None or file.finish()):
        rerun_environment.abandoned = True


class _PipedFile:
    """A file that is written through a pipe, whose other end never fails; empty where it could not be written."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self._outlet, self._inlet = os.pipe()
        self.entrance = _OPEN_FILES / str(self._inlet)
        self._thread = threading.Thread(target=self._write, name="recording", daemon=True)
        self._thread.start()

    def close_entrance(self) -> None:
        """The other writer has opened the entrance by now; when it closes it, the file ends."""
        os.close(self._inlet)

    def finish(self) -> bool:
        """Wait until all is written; whether it was."""
        self._thread.join(_PIPE_S)
        return not self._thread.is_alive()

    def _write(self) -> None:
        failed = False
        try:
            with self._file as file:
                while piece := os.read(self._outlet, _PIECE):
                    try:
                        left = memoryview(b"" if failed else piece)
                        while left:  # a disk that fills up first writes a part
                            left = left[os.write(file.fileno(), left) :]
                    except OSError:
                        failed = True
                        with contextlib.suppress(OSError):  # a failing disk, or no file on one
                            file.truncate(0)
        finally:
            os.close(self._outlet)


_SCAN_COLOUR, _CLOSED_COLOUR, _LOOP_COLOUR = (240, 228, 66), (86, 180, 233), (204, 121, 167)
# The growing map is shown this far around the sensor.
_NEAR_M = 60.0
# Entity, title, and the names of its series.
_PLOTS = (
    ("ms", "ms per scan", STAGES),
    ("residual", "Residual [m]", ("median point to plane",)),
    ("inliers", "Inlier ratio", ("worst direction",)),
)


class RerunViewer(Viewer):
    """Logs a run to a Rerun recording."""

    def __init__(self, recording: rr.RecordingStream, config: ViewerConfig) -> None:
        self._recording = recording
        self._config = config
        self._last_position: FloatArray | None = None
        for plot, _, names in _PLOTS:
            recording.log(f"plots/{plot}", rr.SeriesLines(names=names), static=True)

    def wants_map(self, index: int) -> bool:
        """Whether the map is shown after this scan: at a fixed interval."""
        return index % self._config.map_every == 0

    def show_reference(self, reference: Trajectory) -> None:
        """The whole true path, at once."""
        self._recording.log("world/ground_truth", true_path(reference), static=True)

    def show_scan(self, index: int, result: ScanEstimate) -> None:
        """The scan at its pose, the next piece of the trajectory, the next value of every plot."""
        set_stamp(self._recording, index, result.stamp)
        T = result.T_world_lidar
        self._recording.log("world/lidar", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        points = every_nth(result.points, self._config.scan_points)
        self._recording.log("world/lidar/scan", rr.Points3D(points, colors=[_SCAN_COLOUR], radii=SCAN_RADIUS))
        self._log_path(T[:3, 3], result.status)
        self._recording.log("plots/ms", rr.Scalars([result.stage_ms.get(stage, 0.0) for stage in STAGES]))
        for plot, value in (("residual", result.residual_m), ("inliers", result.inlier_ratio)):
            if value is not None:
                self._recording.log(f"plots/{plot}", rr.Scalars(value))
        if result.message:
            level = rr.TextLogLevel.ERROR if result.status is Status.LOST else rr.TextLogLevel.WARN
            self._recording.log("log", rr.TextLog(result.message, level=level))

    def show_map(self, points: FloatArray) -> None:
        """The part of the map around the sensor."""
        if self._last_position is not None:
            points = points[np.linalg.norm(points - self._last_position, axis=1) < _NEAR_M]
        self.show_final_map(points)

    def show_final_map(self, points: FloatArray) -> None:
        """All of the map, coloured by height."""
        log_map(self._recording, "world/map", points, self._config.map_points)

    def show_closed(self, positions: FloatArray, loops: Sequence[tuple[int, int]]) -> None:
        """The corrected path next to the one before, and the loops."""
        path = rr.LineStrips3D([positions], colors=[_CLOSED_COLOUR], radii=PATH_RADIUS, labels=["loops closed"])
        self._recording.log("world/closed/trajectory", path)
        pairs = positions[np.array(loops, dtype=np.intp).reshape(-1, 2)]
        self._recording.log(
            "world/closed/loops", rr.LineStrips3D(list(pairs), colors=[_LOOP_COLOUR], radii=PATH_RADIUS)
        )

    def _log_path(self, position: FloatArray, status: Status) -> None:
        """Only the newest piece: the view shows all pieces up to the present, so the recording grows linearly."""
        if self._last_position is not None:
            piece = np.stack([self._last_position, position])
            line = rr.LineStrips3D([piece], colors=[STATUS_COLOURS[status]], radii=PATH_RADIUS)
            self._recording.log("world/trajectory", line)
        self._last_position = position.copy()


@contextlib.contextmanager
def rerun_viewer(
    name: str, config: ViewerConfig, path: Path, window: bool = False, page: WebPage | None = None
) -> Iterator[RerunViewer]:
    """A viewer that writes the recording `path`, and shows it in a window or on a page too if asked for."""
    if window:
        open_window(GRPC_PORT)
    with (
        contextlib.ExitStack() as shown,
        rerun_recording(name, path, rr.GrpcSink() if window else None, _blueprint()) as recording,
    ):
        if page is not None:
            shown.enter_context(page.showing(path))
        yield RerunViewer(recording, config)


def _blueprint() -> rrb.Blueprint:
    space = rrb.Spatial3DView(
        origin="/world",
        name="Trajectory and map",
        background=BACKGROUND,
        overrides={"world/trajectory": [rrb.VisibleTimeRanges(whole_past())]},
    )
    plots = [rrb.TimeSeriesView(origin=f"/plots/{plot}", name=title) for plot, title, _ in _PLOTS]
    messages = rrb.TextLogView(origin="/log", name="Messages")
    return rrb.Blueprint(
        rrb.Horizontal(space, rrb.Vertical(*plots, messages), column_shares=[3, 1]),
        rrb.TimePanel(timeline=SCAN, play_state="following", state="collapsed"),
        collapse_panels=True,
    )
