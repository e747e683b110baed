"""Scenes shown in Rerun: in a file, a window or a browser."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import cannot_write, replacing
from lidarslam.core.text import one_line
from lidarslam.viewer import rerun_environment
from lidarslam.viewer.rerun_program import GRPC_PORT, open_window, require_window
from lidarslam.viewer.rerun_recording import (
    FLUSH_S,
    OPEN_FILES,
    IncompleteRecordingError,
    require_complete,
    rerun_recording,
)  # fmt: skip
from lidarslam.viewer.web_page import WebPage

_INSTEAD = "write a file with --save FILE.rrd, or use --web"
_MAGIC = b"RRF2"


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
            recording.flush(timeout_sec=FLUSH_S)
        except RuntimeError as error:
            rerun_environment.abandoned = True
            raise OutputError(f"the Rerun window cannot be reached ({one_line(str(error))}); {_INSTEAD}") from error


def show_on_page(show: Show, page: WebPage) -> None:
    """Show it in a browser; it is in a temporary file without a name, removed with the program."""
    with tempfile.TemporaryFile() as file:
        path = OPEN_FILES / str(file.fileno())
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
