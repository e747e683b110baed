"""A page on this machine that shows a Rerun recording in the browser, also one that is still being written.

Rerun's own page loads a font and reports usage to its makers; this one serves the same viewer with a
Content-Security-Policy that forbids every address but its own. The recording comes over the same port.
"""

import contextlib
import os
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, urlsplit

from lidarslam.core.errors import OutputError

LOCAL = "127.0.0.1"
# The first free one of these; Rerun's own default comes first.
_PORTS = range(9090, 9110)
_INDEX, _RECORDING = "/", "/recording.rrd"
# Of the viewer: our colours are chosen for a dark ground, and nothing is kept in the browser.
_OPTIONS = "&theme=dark&persist=false&hide_welcome_screen"
_PIECE, _POLL_S = 1 << 20, 0.1
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


class WebPage:
    """The page and the recording on it."""

    def __init__(self, files: Mapping[str, bytes], announce: Callable[[str], None] = lambda _: None) -> None:
        """Begin to serve files by their paths, "/" is the page; the address is announced with a recording to show."""
        self._announce = announce
        self._server = _bind()
        self._server.files = {**files, _INDEX: _LINK_ELSEWHERE.sub(b"", files[_INDEX])}
        self.address = f"http://{LOCAL}:{self._server.server_port}"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_POLL_S,), name="web page", daemon=True
        )
        self._thread.start()

    @contextlib.contextmanager
    def showing(self, path: Path) -> Iterator[None]:
        """Show a recording while it is written; it is complete when the block ends, and may be renamed or removed."""
        self._server.descriptor = os.open(path, os.O_RDONLY)
        self._announce(self.address)
        try:
            yield
        finally:
            self._server.complete.set()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
        if self._server.descriptor is not None:
            os.close(self._server.descriptor)


class _Server(ThreadingHTTPServer):
    daemon_threads, block_on_close = True, False
    allow_reuse_address = False  # a port of another program is not shared

    files: Mapping[str, bytes]
    descriptor: int | None = None  # the recording

    def __init__(self, port: int) -> None:
        super().__init__((LOCAL, port), _Request)
        self.complete = threading.Event()  # whether all of the recording is written

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that went away is none."""


def _bind() -> _Server:
    for port in _PORTS:
        with contextlib.suppress(OSError):
            return _Server(port)
    raise OutputError(f"the ports {_PORTS[0]} to {_PORTS[-1]} are in use; end another lidarslam or Rerun first")


class _Request(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: _Server

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
        """From its beginning, and the data written to it from now on."""
        self._begin(HTTPStatus.OK, {"Content-Type": "application/octet-stream", "Transfer-Encoding": "chunked"})
        for piece in self._pieces():
            self.wfile.write(b"%x\r\n%b\r\n" % (len(piece), piece))
        self.wfile.write(b"0\r\n\r\n")

    def _pieces(self) -> Iterator[bytes]:
        offset, server = 0, self.server
        while True:
            complete = server.complete.is_set()  # before reading: data written in between is read next time
            piece = b"" if server.descriptor is None else os.pread(server.descriptor, _PIECE, offset)
            if piece:
                offset += len(piece)
                yield piece
            elif complete:
                return
            else:
                server.complete.wait(_POLL_S)
