"""Rerun's program: its window, and its page for browsers. Both listen on this machine alone.

Started by Rerun's library they would be open to the network. `python -m lidarslam.viewer.rerun_program COMMAND...`
runs a command until standard input ends, which it does with the process that holds its other end, however that ends.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

from lidarslam.core.errors import OutputError

LOCAL = "127.0.0.1"

# No module is taken from the current folder, where anything may lie, and nobody is asked anything.
_ENVIRONMENT = {"PYTHONSAFEPATH": "1", "RERUN_APP_ONLY": "true"}
_START_S = 30.0
_LOOK_S = 0.05


def is_taken(port: int) -> bool:
    """Whether somebody listens on a port of this machine."""
    with socket.socket() as probe:
        return probe.connect_ex((LOCAL, port)) == 0


def open_window(port: int) -> None:
    """Open the viewer, which takes recordings at a port; one that listens there already is taken.

    Raises:
        OutputError: it cannot be opened.
    """
    if is_taken(port):
        return
    command = [_program(), "--bind", LOCAL, "--port", str(port), "--memory-limit", "75%"]
    process = _start([*command, "--expect-data-soon", "--hide-welcome-screen"], subprocess.DEVNULL)
    if not _listens(process, port):
        raise OutputError("the Rerun window cannot be opened; write a file instead")


def serve_page(port: int, server: str) -> "subprocess.Popen[bytes]":
    """Serve the page that shows what a server has; it ends when its standard input is closed.

    Args:
        port: where the page is.
        server: address of the recording's server.

    Raises:
        OutputError: it cannot be served.
    """
    command = [_program(), "--serve-web", "--bind", LOCAL, "--web-viewer-port", str(port), server]
    process = _start([sys.executable, "-m", "lidarslam.viewer.rerun_program", *command], subprocess.PIPE)
    if not _listens(process, port):
        raise OutputError("the browser cannot be served; write a file with --save FILE.rrd instead")
    return process


def _program() -> str:
    """The program that came with the library, which stands beside this Python and perhaps not on the path."""
    beside = Path(sys.executable).with_name("rerun")
    found = str(beside) if beside.is_file() else shutil.which("rerun")
    if found is None:
        raise OutputError("Rerun's program is not installed; pip install rerun-sdk brings it, or write a file instead")
    return found


def _start(command: list[str], stdin: int) -> "subprocess.Popen[bytes]":
    """In a session of its own, which no Ctrl-C meant for this program reaches."""
    return subprocess.Popen(
        command,
        stdin=stdin,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | _ENVIRONMENT,
        start_new_session=True,
    )


def _listens(process: "subprocess.Popen[bytes]", port: int) -> bool:
    """Wait until it listens; it is ended where it does not."""
    begun = time.monotonic()
    while process.poll() is None and time.monotonic() - begun < _START_S:
        if is_taken(port):
            return True
        time.sleep(_LOOK_S)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return False


def _end_with_input() -> None:
    sys.stdin.buffer.read()
    os.killpg(0, signal.SIGTERM)  # what was started may have started others


def main() -> int:
    """Run the command of the arguments; its exit status."""
    with subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL) as process:
        threading.Thread(target=_end_with_input, daemon=True).start()
        return process.wait()


if __name__ == "__main__":
    sys.exit(main())
