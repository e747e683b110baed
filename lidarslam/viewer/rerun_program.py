"""Rerun's program: its window, and the files of its page for browsers.

It listens on this machine alone; started by Rerun's library it would be open to the network.
"""

import contextlib
import http.client
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from lidarslam.core.errors import OutputError
from lidarslam.core.tasks import bound
from lidarslam.viewer.web_page import LOCAL, WebPage

# Rerun's own default.
GRPC_PORT = 9876

# Set where Linux has a display.
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_START_S, _POLL_S = 30.0, 0.05
_PAGE_FILES = ("/", "/re_viewer.js", "/re_viewer_bg.wasm", "/favicon.ico")
# It asks GitHub for a newer version of itself, through a proxy if there is one; at this port there is none.
_NOWHERE = f"http://{LOCAL}:1"
_NO_NETWORK = dict.fromkeys(("ALL_PROXY", "all_proxy", "HTTPS_PROXY", "https_proxy"), _NOWHERE)
# The program serves its page alone, and no recordings, where it is given a server of recordings.
_NO_SERVER = f"rerun+http://{LOCAL}:1/proxy"


def is_taken(port: int) -> bool:
    """Whether a program listens on a port of this machine."""
    with socket.socket() as probe:
        return probe.connect_ex((LOCAL, port)) == 0


def require_window(instead: str) -> None:
    """Check that a window can be opened, before anything is computed for it; `instead` names the alternative."""
    # A viewer that runs already, perhaps at the other end of a tunnel, needs no display here.
    if sys.platform == "linux" and not any(map(os.environ.get, _DISPLAYS)) and not is_taken(GRPC_PORT):
        raise OutputError(f"no display to open a window on; {instead}")


def open_window(port: int, recording: Path | None = None) -> None:
    """Open the viewer, which takes recordings at a port, unless it is open already, and show a file."""
    options = ["--port", str(port), "--memory-limit", "75%", "--expect-data-soon", "--hide-welcome-screen"]
    if recording is not None:
        options.append(str(recording.resolve()))
    if not is_taken(port):
        opened = _start(port, *options) is not None
    else:  # a second one sends the file to the first and ends
        opened = recording is None or _launch(*options).wait() == 0
    if not opened:
        raise OutputError("the Rerun window cannot be opened; write a file instead")


@contextlib.contextmanager
def served_page(announce: Callable[[str], None]) -> Iterator[WebPage]:
    """A page for browsers on this machine, during the block; its address is announced with the first content."""
    with contextlib.closing(WebPage(_page_files(), announce)) as page:
        yield page


def _page_files() -> dict[str, bytes]:
    """The files of the viewer for browsers, by their paths on its page; they are part of the program."""
    with socket.socket() as probe:
        probe.bind((LOCAL, 0))
        port = probe.getsockname()[1]
    process = _start(port, "--serve-web", "--web-viewer-port", str(port), _NO_SERVER)
    if process is None:
        raise OutputError("Rerun's page for browsers cannot be had; write a file instead")
    try:
        with bound(process):
            return {path: _fetch(port, path) for path in _PAGE_FILES}
    except (http.client.HTTPException, OSError) as error:
        raise OutputError(f"Rerun's page for browsers cannot be had ({error}); write a file instead") from error


def _fetch(port: int, path: str) -> bytes:
    """A file of the page, from this machine."""
    with contextlib.closing(http.client.HTTPConnection(LOCAL, port, timeout=_START_S)) as connection:
        connection.request("GET", path)
        response = connection.getresponse()
        if response.status != http.client.OK:
            raise OSError(f"{path}: {response.status} {response.reason}")
        return response.read()


def _program() -> str:
    """The program that came with the library, next to this Python if not on the path."""
    beside = Path(sys.executable).with_name("rerun")
    found = str(beside) if beside.is_file() else shutil.which("rerun")
    if found is None:
        raise OutputError("Rerun's program is not installed; pip install rerun-sdk brings it, or write a file instead")
    return found


def _start(port: int, *options: str) -> "subprocess.Popen[bytes] | None":
    """Start the program and wait until it listens; None where it does not."""
    process = _launch(*options)
    begun, listens = time.monotonic(), False
    try:
        while process.poll() is None and time.monotonic() - begun < _START_S and not listens:
            time.sleep(_POLL_S)
            listens = is_taken(port)
    finally:
        if not listens:
            if process.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # with its children
            process.wait()
    return process if listens else None


def _launch(*options: str) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        [_program(), "--bind", LOCAL, *options],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        # No module from the current folder, no questions.
        env=os.environ | {"PYTHONSAFEPATH": "1", "RERUN_APP_ONLY": "true"} | _NO_NETWORK,
        start_new_session=True,  # Ctrl-C is not meant for it
    )
