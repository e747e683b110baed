"""Rerun's program: its window, and its page for browsers.

Both listen on this machine alone; started by Rerun's library they would be open to the network.
"""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from lidarslam.core.errors import OutputError

LOCAL = "127.0.0.1"
# Rerun's own defaults.
GRPC_PORT, WEB_PORT = 9876, 9090

_START_S, _POLL_S = 30.0, 0.05


def is_taken(port: int) -> bool:
    """Whether a program listens on a port of this machine."""
    with socket.socket() as probe:
        return probe.connect_ex((LOCAL, port)) == 0


def open_window(port: int) -> None:
    """Open the viewer, which takes recordings at a port, unless it is open already.

    Raises:
        OutputError: it cannot be opened.
    """
    options = ("--port", str(port), "--memory-limit", "75%", "--expect-data-soon", "--hide-welcome-screen")
    if not is_taken(port) and _start(port, *options) is None:
        raise OutputError("the Rerun window cannot be opened; write a file instead")


@contextlib.contextmanager
def page_served(port: int, server: str) -> Iterator[None]:
    """Serve the page that shows a recording's server, for the time of the block.

    Args:
        port: of the page.
        server: address of the recording's server.

    Raises:
        OutputError: it cannot be served.
    """
    process = _start(port, "--serve-web", "--web-viewer-port", str(port), server)
    if process is None:
        raise OutputError("the browser cannot be served; write a file with --save FILE.rrd instead")
    try:
        yield
    finally:
        _end(process)


def _program() -> str:
    """The program that came with the library, beside this Python if not on the path."""
    beside = Path(sys.executable).with_name("rerun")
    found = str(beside) if beside.is_file() else shutil.which("rerun")
    if found is None:
        raise OutputError("Rerun's program is not installed; pip install rerun-sdk brings it, or write a file instead")
    return found


def _start(port: int, *options: str) -> "subprocess.Popen[bytes] | None":
    """Start the program and wait until it listens; None where it does not."""
    process = subprocess.Popen(
        [_program(), "--bind", LOCAL, *options],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        # No module from the current folder, no questions.
        env=os.environ | {"PYTHONSAFEPATH": "1", "RERUN_APP_ONLY": "true"},
        start_new_session=True,  # Ctrl-C is not meant for it
    )
    begun, listens = time.monotonic(), False
    try:
        while process.poll() is None and time.monotonic() - begun < _START_S and not listens:
            time.sleep(_POLL_S)
            listens = is_taken(port)
    finally:
        if not listens:
            _end(process)
    return process if listens else None


def _end(process: "subprocess.Popen[bytes]") -> None:
    """With whatever it started."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
