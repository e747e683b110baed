"""Finished runs and map errors in Rerun: saved, in a window, or served to a browser."""

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lidarslam.config.settings import ViewerConfig
from lidarslam.core.errors import OutputError
from lidarslam.core.files import cannot_write, replacing
from lidarslam.core.geometry import FloatArray
from lidarslam.core.plain_text import one_line
from lidarslam.core.tracking import Status
from lidarslam.evaluation.map.metrics import CloudErrors, MapComparison
from lidarslam.evaluation.report.error_colours import error_colours
from lidarslam.storage.finished_run import FinishedRun
from lidarslam.viewer import rerun_environment
from lidarslam.viewer.rerun_program import GRPC_PORT, LOCAL, WEB_PORT, is_taken, open_window, page_served
from lidarslam.viewer.rerun_recording import (
    FLUSH_S,
    MAP_RADIUS,
    PATH_RADIUS,
    REFERENCE_COLOUR,
    STATUS_COLOURS,
    IncompleteRecordingError,
    log_map,
    loop_lines,
    rerun_recording,
)

# What says that Linux has a display.
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_RUN_COLOURS = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0))


def save_runs(runs: Sequence[FinishedRun], config: ViewerConfig, path: Path) -> None:
    """Write trajectories, lost scans, loops and maps of runs to a .rrd file.

    Raises:
        OutputError: it cannot be written.
    """
    try:
        with replacing(path) as partial, rerun_recording(partial) as recording:
            _log_runs(recording, runs, config)
    except (OSError, IncompleteRecordingError) as error:
        raise cannot_write(path, error, "; name another file") from error


def open_runs(runs: Sequence[FinishedRun], config: ViewerConfig) -> None:
    """Show runs in a window.

    Raises:
        OutputError: there is no display, or the window cannot be opened.
    """
    # A viewer that runs already, perhaps at the other end of a tunnel, needs no display here.
    if sys.platform == "linux" and not any(map(os.environ.get, _DISPLAYS)) and not is_taken(GRPC_PORT):
        raise OutputError("no display to open a window on; write a file with --save FILE.rrd, or use --web")
    open_window(GRPC_PORT)
    with rerun_recording(None, [rr.GrpcSink()]) as recording:
        _log_runs(recording, runs, config)
        try:
            recording.flush(timeout_sec=FLUSH_S)
        except RuntimeError as error:
            rerun_environment.abandoned = True
            raise OutputError(
                f"the Rerun window cannot be reached ({one_line(str(error))});"
                " write a file with --save FILE.rrd, or use --web"
            ) from error


@contextlib.contextmanager
def served_runs(runs: Sequence[FinishedRun], config: ViewerConfig) -> Iterator[str]:
    """Serve runs to browsers on this machine for the time of the block; the address.

    Raises:
        OutputError: a port is in use, or the page cannot be served.
    """
    for port in (GRPC_PORT, WEB_PORT):
        if is_taken(port):
            raise OutputError(
                f"port {port} is in use; close the Rerun viewer or the lidarslam view --web that has it,"
                " or write a file with --save FILE.rrd"
            )
    with rerun_recording(None, [rr.GrpcServerSink(bind_ip=LOCAL, port=GRPC_PORT)]) as recording:
        _log_runs(recording, runs, config)
        server = f"rerun+http://{LOCAL}:{GRPC_PORT}/proxy"
        with page_served(WEB_PORT, server):
            yield f"http://{LOCAL}:{WEB_PORT}/?url={quote(server, safe='')}"


def _log_runs(recording: rr.RecordingStream, runs: Sequence[FinishedRun], config: ViewerConfig) -> None:
    for number, run in enumerate(runs):
        entity: list[object] = ["world", f"{number}_{run.name}"]
        positions, colour = run.trajectory.positions, _RUN_COLOURS[number % len(_RUN_COLOURS)]
        path = rr.LineStrips3D([positions], colors=[colour], radii=PATH_RADIUS, labels=[run.name])
        recording.log([*entity, "trajectory"], path, static=True)
        lost = rr.Points3D(positions[run.lost], colors=[STATUS_COLOURS[Status.LOST]], radii=2.0 * PATH_RADIUS)
        recording.log([*entity, "lost"], lost, static=True)
        if len(run.loops):
            recording.log([*entity, "loops"], loop_lines(positions, run.loops), static=True)
        log_map(recording, [*entity, "map"], run.map_points, config.map_points)


def save_errors(path: Path, comparison: MapComparison, positions: FloatArray | None, clip_m: float) -> None:
    """Write a .rrd file of a map coloured by its distance to the reference, and of the reference by that to the map.

    Args:
        path: the file.
        comparison: shown about its middle, because the viewer counts in single precision.
        positions: (K, 3) where the sensor was, in the reference's frame.
        clip_m: the distance of the brightest colour.

    Raises:
        OutputError: the file cannot be written.
    """
    points = comparison.reference_errors.points
    middle = np.round(points.mean(axis=0)) if len(points) else np.zeros(3)
    try:
        with rerun_recording(path, blueprint=_errors_blueprint()) as recording:
            _log_errors(recording, "world/map_to_reference", comparison.map_errors, middle, clip_m)
            _log_errors(recording, "world/reference_to_map", comparison.reference_errors, middle, clip_m)
            if positions is not None:
                line = rr.LineStrips3D([positions - middle], colors=[REFERENCE_COLOUR], radii=PATH_RADIUS)
                recording.log("world/path", line, static=True)
            origin = ", ".join(f"{m:.0f}" for m in middle)
            text = f"dark: 0 m, bright: {clip_m:g} m and more; the origin is at {origin}"
            recording.log("legend", rr.TextDocument(text), static=True)
    except (OSError, IncompleteRecordingError) as error:
        raise cannot_write(path, error) from error


def _log_errors(
    recording: rr.RecordingStream, entity: str, errors: CloudErrors, middle: FloatArray, clip_m: float
) -> None:
    colours = error_colours(errors.distances_m, clip_m)
    recording.log(entity, rr.Points3D(errors.points - middle, colors=colours, radii=MAP_RADIUS), static=True)


def _errors_blueprint() -> rrb.Blueprint:
    """Both clouds side by side, above the legend."""
    titles = {
        "map_to_reference": "Map: distance to the reference",
        "reference_to_map": "Reference: distance to the map",
    }
    views = [
        rrb.Spatial3DView(origin="/world", name=title, contents=["/world/path", f"/world/{entity}"])
        for entity, title in titles.items()
    ]
    legend = rrb.TextDocumentView(origin="/legend", name="Colours")
    return rrb.Blueprint(rrb.Vertical(rrb.Horizontal(*views), legend, row_shares=[8, 1]), collapse_panels=True)
