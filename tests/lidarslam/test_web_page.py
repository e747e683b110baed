"""The page for browsers: it loads nothing from elsewhere, and shows a recording while it is written."""

import http.client
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from lidarslam.core.errors import OutputError
from lidarslam.viewer import web_page
from lidarslam.viewer.rerun_program import served_page
from lidarslam.viewer.web_page import WebPage

INDEX = b"""<html><link rel="icon" href="favicon.ico" />
<link rel="preconnect" href="https://fonts.gstatic.com" crossorigin />
<link
  href="//fonts.googleapis.com/css2?family=Inter"
  rel="stylesheet"
/><script src="re_viewer.js"></script></html>"""


@pytest.fixture
def page() -> Iterator[WebPage]:
    page = WebPage({"/": INDEX, "/re_viewer.js": b"// viewer"})
    yield page
    page.close()


def get(page: WebPage, path: str, host: str | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(page.address).port or 0, timeout=20)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    return connection.getresponse()


def allowed(response: http.client.HTTPResponse) -> dict[str, list[str]]:
    """The sources that the page's policy allows, for each kind of content."""
    policy = response.headers["Content-Security-Policy"]
    return {words[0]: words[1:] for words in (part.split() for part in policy.split(";"))}


def test_the_page_may_load_from_its_own_server_alone(page: WebPage) -> None:
    for path in ("/?url=there", "/re_viewer.js", "/"):
        kinds = allowed(get(page, path))
        assert kinds["default-src"] == ["'none'"]
        assert kinds["connect-src"] == ["'self'"]
        words = {word for sources in kinds.values() for word in sources}
        assert not {word for word in words if "*" in word or "http" in word}, words
    # A policy does not keep a browser from connecting in advance.
    body = get(page, "/?url=there").read()
    assert b"gstatic" not in body
    assert b"googleapis" not in body
    assert b'href="favicon.ico"' in body
    assert b"re_viewer.js" in body


def test_the_viewer_is_reruns_own() -> None:
    """Whatever its page names of elsewhere is not loaded, or only when clicked."""
    with served_page(lambda _: None) as page:
        body = get(page, "/?url=there").read().decode()
        assert not re.search(r"<link[^>]*(https?:)?//", body)
        for script in re.findall(r"<script[^>]*src=\"([^\"]+)\"", body):
            assert get(page, f"/{script}").status == 200
        assert get(page, "/re_viewer_bg.wasm").read(4) == b"\0asm"


def test_a_recording_is_shown_while_it_is_written(page: WebPage, tmp_path: Path) -> None:
    announced: list[str] = []
    page._announce = announced.append
    path = tmp_path / "recording.rrd"
    with path.open("wb", buffering=0) as file, page.showing(path):
        assert announced == [page.address]
        file.write(b"begun, ")
        early = get(page, "/recording.rrd")
        assert early.read(7) == b"begun, "
        file.write(b"continued, ")
        assert early.read(11) == b"continued, "
        path.rename(tmp_path / "renamed.rrd")  # as a run does at its end
        file.write(b"ended")
    assert early.read() == b"ended"
    assert get(page, "/recording.rrd").read() == b"begun, continued, ended"


def test_the_recording_is_found_at_the_end_of_a_tunnel_too(page: WebPage) -> None:
    response = get(page, "/", "localhost:1234")
    assert response.status == 302
    asked = parse_qs(urlsplit(response.headers["Location"]).query)
    assert asked["url"] == ["http://localhost:1234/recording.rrd"]


def test_a_name_that_was_made_to_point_here_is_refused(page: WebPage) -> None:
    """Otherwise any page in the browser could read the recording."""
    assert get(page, "/recording.rrd", "elsewhere.example:9090").status == 403
    assert get(page, "/", "elsewhere.example").status == 403


def test_a_port_in_use_is_passed_over(page: WebPage, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = urlsplit(page.address).port
    other = WebPage({"/": INDEX})
    other.close()
    assert urlsplit(other.address).port != taken
    monkeypatch.setattr(web_page, "_PORTS", [taken])
    with pytest.raises(OutputError, match=f"{taken}.* in use"):
        WebPage({"/": INDEX})


def test_this_machine_alone_is_served(page: WebPage) -> None:
    """A server on all interfaces would be there on each address of the loopback; one on 127.0.0.1 is on that alone."""
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.2", urlsplit(page.address).port or 0)) != 0
