"""Rerun's window, and a page on this machine that shows a recording in the browser, also one still being written.

Rerun's program listens on this machine alone; started by Rerun's library it would be open to the network. Its own page
loads a font and reports usage to its makers; ours serves the same viewer with a Content-Security-Policy that forbids
every address but its own. The recording comes over the same port.
"""

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from http.client import HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, urlsplit
from urllib.request import ProxyHandler, build_opener

from lidarslam.core.errors import OutputError
from lidarslam.core.tasks import bound

LOCAL = "127.0.0.1"
# The first free one of these; Rerun's own default comes first.
_PORTS = range(9090, 9110)
_INDEX, _RECORDING = "/", "/recording.rrd"
# Of the viewer: our colours are chosen for a dark ground, and nothing is kept in the browser.
_OPTIONS = "&theme=dark&persist=false&hide_welcome_screen"
_PIECE, _POLL_S = 1 << 20, 0.1
# Rerun's own default.
GRPC_PORT = 9876
# Set where Linux has a display.
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_START_S = 30.0
_PAGE_FILES = ("/", "/re_viewer.js", "/re_viewer_bg.wasm", "/favicon.ico")
# It asks GitHub for a newer version of itself, through a proxy if there is one; at this port there is none.
_NOWHERE = f"http://{LOCAL}:1"
_NO_NETWORK = dict.fromkeys(("ALL_PROXY", "all_proxy", "HTTPS_PROXY", "https_proxy"), _NOWHERE)
# The program serves its page alone, and no recordings, where it is given a server of recordings.
_NO_SERVER = f"rerun+http://{LOCAL}:1/proxy"
_TYPES = {".js": "text/javascript", ".wasm": "application/wasm", ".ico": "image/x-icon", ".png": "image/png"}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval';"
    " style-src 'unsafe-inline'; img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-DNS-Prefetch-Control": "off",
}
# A policy does not keep a browser from opening a connection in advance.
_LINK_ELSEWHERE = re.compile(rb"<link\b[^>]*?\bhref=[\"'](?:https?:)?//[^>]*>", re.DOTALL)


class WebPage(ThreadingHTTPServer):
    """The page and the recording on it."""

    daemon_threads, block_on_close = True, False
    allow_reuse_address = False  # a port of another program is not shared

    def __init__(self, files: Mapping[str, bytes], announce: Callable[[str], None] = lambda _: None) -> None:
        """Begin to serve files by their paths, "/" is the page; the address is announced with a recording to show."""
        for port in _PORTS:
            with contextlib.suppress(OSError):
                super().__init__((LOCAL, port), _Request)
                break
        else:
            raise OutputError(f"the ports {_PORTS[0]} to {_PORTS[-1]} are in use; end another lidarslam or Rerun first")
        self._announce = announce
        self.files = {**files, _INDEX: _LINK_ELSEWHERE.sub(b"", files[_INDEX])}
        self.descriptor: int | None = None  # of the recording
        self.complete = threading.Event()  # whether all of the recording is written
        self.address = f"http://{LOCAL}:{self.server_port}"
        threading.Thread(target=self.serve_forever, args=(_POLL_S,), name="web page", daemon=True).start()

    @contextlib.contextmanager
    def showing(self, path: Path) -> Iterator[None]:
        """Show a recording while it is written; it is complete when the block ends, and may be renamed or removed."""
        self.descriptor = os.open(path, os.O_RDONLY)
        self._announce(self.address)
        try:
            yield
        finally:
            self.complete.set()

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that went away is none."""

    def close(self) -> None:
        """Stop serving."""
        self.shutdown()
        self.server_close()
        if self.descriptor is not None:
            os.close(self.descriptor)


class _Request(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: WebPage

    def do_GET(self) -> None:
        """A file of the viewer, or the recording."""
        host, place = self.headers.get("Host", ""), urlsplit(self.path)
        if urlsplit(f"//{host}").hostname not in (LOCAL, "localhost"):  # a foreign name that resolves to here
            self.send_error(HTTPStatus.FORBIDDEN)
        elif place.path == _INDEX and "url=" not in place.query:
            # The address as the browser knows it, which at the end of a tunnel may be another.
            recording = quote(f"http://{host}{_RECORDING}", safe="")
            self._begin(HTTPStatus.FOUND, {"Location": f"/?url={recording}{_OPTIONS}", "Content-Length": "0"})
        elif place.path == _RECORDING:
            self._send_recording()
        elif (content := self.server.files.get(place.path)) is not None:
            kind = _TYPES.get(Path(place.path).suffix, "text/html; charset=utf-8")
            self._begin(HTTPStatus.OK, {"Content-Type": kind, "Content-Length": str(len(content))})
            self.wfile.write(content)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not logged."""

    def _begin(self, status: HTTPStatus, headers: Mapping[str, str]) -> None:
        self.send_response(status)
        for name, value in {**headers, **_HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()

    def _send_recording(self) -> None:
        self._begin(HTTPStatus.OK, {"Content-Type": "application/octet-stream", "Transfer-Encoding": "chunked"})
        offset, server, complete = 0, self.server, False
        while not complete:
            is_whole = server.complete.is_set()  # before reading: data written in between is read next time
            piece = b"" if server.descriptor is None else os.pread(server.descriptor, _PIECE, offset)
            offset += len(piece)
            complete = is_whole and not piece
            if piece or complete:  # an empty one is the end
                self.wfile.write(b"%x\r\n%b\r\n" % (len(piece), piece))
            else:
                server.complete.wait(_POLL_S)


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
    # No proxy of the environment: the files come from this machine.
    fetch = build_opener(ProxyHandler({})).open
    try:
        with bound(process):
            return {path: fetch(f"http://{LOCAL}:{port}{path}", timeout=_START_S).read() for path in _PAGE_FILES}
    except (HTTPException, OSError) as error:
        raise OutputError(f"Rerun's page for browsers cannot be had ({error}); write a file instead") from error


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
            time.sleep(0.5 * _POLL_S)
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
